"""The README's own text, run."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bench import config, registry

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
EXAMPLES = dict(re.findall(r"```python\n# (plugins/\S+)\n(.*?)```", README, re.DOTALL))


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the project with the README's plugins dropped in."""
    root = tmp_path_factory.mktemp("tree")
    for name in ("bench", "plugins", "conf"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path, text in EXAMPLES.items():
        (root / path).write_text(text)
    return root


def bench(tree, *words):
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    command = [sys.executable, "-P", "-m", "bench", *words]
    return subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=300)


def test_an_estimator_takes_at_most_25_lines():
    assert len(EXAMPLES["plugins/estimators/clipped_fobg.py"].strip().splitlines()) <= 25


@pytest.mark.parametrize("path", EXAMPLES)
def test_example_is_listed_and_passes_the_kit(tree, path):
    name = Path(path).stem
    listed = bench(tree, "list", name)
    assert name in listed.stdout
    checked = bench(tree, "check", name)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_examples_run_together(tree, tmp_path):
    done = bench(
        tree, "scenes=[sliding_mass]", "backends=[numpy,jax]", "estimators=[fobg,clipped_fobg]",
        "estimator.clipped_fobg.limit=0.5", "scene.sliding_mass.mass=2", "samples=16", "repeats=8", "name=mine",
        f"results_dir={tmp_path}",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "clipped_fobg[limit=0.5]" in done.stdout


def test_every_scene_and_experiment_is_described():
    for name in registry.entries()["scenes"]:
        assert f"| `{name}` |" in README
    for name in config.experiments():
        assert f"| `{name}` |" in README


def test_module_map_is_complete():
    for path in (ROOT / "bench").glob("*.py"):
        if not path.name.startswith("__"):
            assert f"bench/{path.name}" in README


def test_readme_and_repository_have_the_files_they_name():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
