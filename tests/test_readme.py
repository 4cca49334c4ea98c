"""The text of README and docs, checked and run: links, commands, examples, and lists of what there is."""

import os
import re
import shlex
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import pytest
import yaml

import bench
from bench import cli
from bench.experiment import config
from bench.experiment.cell import Cell
from bench.model import registry

ROOT = Path(__file__).resolve().parent.parent
DOCS = {path.name: path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))}
README = (ROOT / "README.md").read_text()
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *(ROOT / folder / "README.md" for folder in ("plugins", "conf", "results", "examples/atlas")),
    *(ROOT / "docs" / name for name in DOCS),
]
EXAMPLES = dict(re.findall(r"```python\n# (\S+\.py)\n(.*?)```", DOCS["extending.md"] + DOCS["training.md"], re.DOTALL))
SOFT = "# @package _global_\nscenes: [heaviside]\nbackends: [numpy]\n"
"""The experiment that docs/experiments.md has the reader write."""


def python_blocks(text):
    return [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if not block.startswith("# ")]


def commands(text):
    """The words of every ``python -m bench`` command of a page, without those that have placeholders in capitals."""
    text = re.sub(r"```.*?```", "", text.replace("\\\n", " "), flags=re.DOTALL)
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    lines += re.findall(r"`(python -m bench [^`]+)`", re.sub(r"\s+", " ", text))
    words = [shlex.split(line, comments=True)[3:] for line in lines if line.startswith("python -m bench ")]
    placeholder = re.compile(r"\b(?!HEAD)[A-Z]{3,}\b")
    return [command for command in words if not any(map(placeholder.search, command))]


COMMANDS = [words for path in PAGES for words in commands(path.read_text())]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A directory with nothing in it except examples, the plugins of README and docs/extending.md, and one experiment."""
    root = tmp_path_factory.mktemp("empty")
    for name in ("examples", "plugins"):
        (root / name).symlink_to(ROOT / name)
    subprocess.run(re.findall(r"^    (mkdir .+\n.+)", README, re.MULTILINE)[0], shell=True, cwd=root, check=True)
    (root / "my_experiments" / "experiment").mkdir(parents=True)
    (root / "my_experiments" / "experiment" / "soft.yaml").write_text(SOFT)
    for path, text in EXAMPLES.items():
        (root / path).parent.mkdir(exist_ok=True)
        (root / path).write_text(text)
    return root


def python(folder, *words):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


# ----------------------------------------------------------------------------------------------- links and lists


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_lead_somewhere(path):
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", path.read_text()):
        name, _, anchor = target.partition("#")
        there = (path.parent / name).resolve() if name else path
        assert there.exists(), target
        assert not anchor or anchor in anchors(there.read_text()), target


def anchors(text):
    """The anchors that a page's headings get."""
    return {
        re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")
        for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    }


def test_every_page_is_linked_from_the_readme():
    assert DOCS.keys() <= set(re.findall(r"\(docs/([\w-]+\.md)", README))


def test_start_takes_few_words():
    """One reads the README, how to read a result, and Python to begin."""
    assert len((README + DOCS["reading-results.md"] + DOCS["python.md"]).split()) < 2200


def test_every_scene_and_experiment_is_described():
    assert registry.entries()["scenes"].keys() <= set(
        re.findall(r"`(\w+)`", DOCS["experiments.md"].partition("\n## Scenes\n")[2])
    )
    assert set(config.experiments()) <= set(re.findall(r"^(?:### |- `)([\w/]+)", DOCS["results.md"], re.MULTILINE))


def test_every_command_and_setting_is_described():
    verbs, _, settings = DOCS["commands.md"].partition("\n## Settings\n")
    assert set(cli.VERBS) <= set(re.findall(r"^## (\w+)$", verbs, re.MULTILINE))
    names = yaml.safe_load((config.config_dir() / "config.yaml").read_text()).keys() - {"defaults"}
    assert names <= set(re.findall(r"`(\w+)`", settings))


def test_architecture_names_every_package():
    paths = {f"bench/{path.parent.name}/" for path in ROOT.glob("bench/*/__init__.py")}
    paths |= {f"bench/{path.name}" for path in ROOT.glob("bench/*.py")}
    assert paths <= set(re.findall(r"`([\w/.]+)`", DOCS["architecture.md"]))


def test_citation_changelog_and_switcher_have_the_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == bench.__version__
    assert f"\n## {bench.__version__} (" in (ROOT / "CHANGELOG.md").read_text()
    assert f'"{bench.__version__}"' in (ROOT / "docs" / "switcher.json").read_text()


# ------------------------------------------------------------------------------------------------------ commands


def planned(words):
    """The words that plan a command: its cells, or only its help where the command has none."""
    verb, *rest = ["run", *words] if "=" in words[0] or words[0].startswith("-") else words
    if verb in ("gradcheck", "trace"):
        scenes = [w for w in rest if "=" not in w.partition("[")[0]]
        chosen = ["experiment=gradient_check"] * (verb == "gradcheck")
        rest = [*chosen, *[f"scenes=[{','.join(scenes)}]"][: len(scenes)], *rest[len(scenes) :]]
    if verb in ("run", "report", "plan", "gradcheck", "trace"):
        return ["plan", *rest]
    if verb == "check":
        return ["list", *takewhile(lambda word: not word.startswith("-"), rest)]  # then options of pytest
    return ["list", *rest] if verb == "list" else [verb, "--help"]


@pytest.mark.slow
def test_commands_can_be_planned(folder, monkeypatch):
    """A cell of several commands is tried once."""
    reasons = {}
    refusal = Cell.refusal

    def once(cell):
        if cell.key not in reasons:
            reasons[cell.key] = refusal(cell)
        return reasons[cell.key]

    monkeypatch.setattr(Cell, "refusal", once)
    monkeypatch.chdir(folder)
    for words in dict.fromkeys(tuple(planned(words)) for words in COMMANDS):  # in the order of the pages
        assert cli.main(list(words)) == 0, words


@pytest.mark.slow
def test_readme_example_runs(folder, monkeypatch, capsys):
    (example,) = python_blocks(README)
    monkeypatch.chdir(folder)
    exec(example, {})
    printed = capsys.readouterr().out
    assert printed.startswith("Derivative: right.")
    assert "\nUnder noise of sigma 0.010: usable." in printed


@pytest.mark.slow
def test_examples_of_the_python_page_run(folder):
    printed = python(folder, "-c", "\n".join(python_blocks(DOCS["python.md"])))
    assert "fobg on pushing[sigma=0.1], penalty" in printed
    assert printed.count("\nrelative bias ") == 2


# ------------------------------------------------------------------------------------------------------- plugins


@pytest.mark.slow
def test_examples_are_listed_and_pass_the_kit(folder):
    names = [Path(path).stem for path in EXAMPLES if path.startswith("my_plugins/")]
    listed = python(folder, "-m", "bench", "list", "plugins=my_plugins", *names)
    assert all(f"\n  {name} " in listed for name in names)
    # not those with a test of their own, an environment of their own, or a check that takes a minute
    names = set(names) - {"clipped_fobg", "my_engine", "two_sided"}
    python(folder, "-m", "bench", "check", "plugins=my_plugins", *names)


@pytest.mark.slow
def test_the_kit_runs_in_pytest(folder):
    assert " passed" in python(folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my_plugins.py")


@pytest.mark.slow
def test_examples_run_together(folder, tmp_path):
    printed = python(
        folder,
        "-m",
        "bench",
        "name=mine",
        "plugins=my_plugins",
        "scenes=[sliding_mass]",
        "backends=[numpy,jax]",
        "estimators=[fobg,clipped_fobg]",
        "estimator.clipped_fobg.limit=0.5",
        "scene.sliding_mass.mass=2",
        "samples=16",
        "repeats=8",
        f"results_dir={tmp_path}",
    )
    assert "clipped_fobg[limit=0.5]" in printed


@pytest.mark.slow
def test_the_study_of_the_example_writes_its_table(folder, tmp_path):
    (words,) = (words for words in COMMANDS if "study=gradient_norm" in words)
    python(folder, "-m", "bench", *words, f"results_dir={tmp_path}")
    assert "gradient_norm" in (tmp_path / "norms" / "gradient_norm.csv").read_text().partition("\n")[0].split(",")


@pytest.mark.slow
def test_the_trainer_of_the_example_trains(folder, tmp_path):
    python(
        folder,
        "-m",
        "bench",
        "name=climb",
        "study=train[starts=8,evaluations=1]",
        "plugins=my_trainers",
        "scenes=[cartpole_swing[horizon=20,substeps=1]]",
        "backends=[jax]",
        "trainers=[hill_climbing]",
        "trainer.hill_climbing.steps=6400",
        f"results_dir={tmp_path}",
    )
    (row,) = bench.load(tmp_path / "climb").to_dict("records")
    assert row["status"] == "ok"
    assert row["final_return"] > row["first_return"]
