"""The bank of misbehaving plugins is whole; ``misbehave.py`` runs as many of them as are asked for."""

import os
import subprocess
import sys

import misbehave
import pytest
from bench.plugins.scenes.quadratic import Quadratic

from bench.errors import UserError
from bench.experiment import config
from bench.model.parameters import build
from bench.report import reproduce
from bench.run.execute import execute, store_of


def test_the_bank_holds_every_kind_place_and_fault():
    cases = misbehave.bank()
    assert len(cases) == len({case.name for case in cases}) > 700
    chosen = misbehave.drawn(100, 0)
    assert {case.kind for case in chosen} == set(misbehave.KINDS)
    assert {case.fault for case in chosen} == {case.fault for case in cases}
    for case in cases:
        compile(case.text(), case.name, "exec")


@pytest.mark.slow
def test_a_plugin_that_shouts_when_it_is_made_reaches_no_terminal_from_the_report(tmp_path):
    (tmp_path / "mine").mkdir()
    case = misbehave.Case("contacts", "construction", "shouts")
    (tmp_path / "mine" / f"{case.name}.py").write_text(case.text())
    words = ["scenes=[bounce_once[horizon=3]]", "backends=[numpy]", "estimators=[fobg]", "samples=2", "repeats=2"]
    more = ["timing=false", "workers=0", "reference.samples=256", "--quiet", f"results_dir={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-m", "bench", *words, *more, f"plugins=[{tmp_path / 'mine'}]", f"contacts=[{case.name}]"],
        capture_output=True, text=True, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not misbehave.SAID.search(done.stdout + done.stderr)


def test_a_plugin_that_cannot_be_made_again_for_the_page_leaves_a_line_without_its_command(tmp_path, monkeypatch):
    """It was: status 2 and an error of the system without a name, after all cells had run."""
    words = ["scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=2", "repeats=3", "timing=false"]
    experiment = config.load([*words, "workers=0", f"results_dir={tmp_path}"])
    execute(experiment)
    rows = store_of(experiment).load()
    assert reproduce.commands(experiment, rows)[0]

    def refuse(self, **values):
        raise OSError(9, "Bad file descriptor")

    monkeypatch.setattr(Quadratic, "__init__", refuse)
    assert reproduce.commands(experiment, rows) == [[]]
    with pytest.raises(UserError, match="scene 'quadratic' cannot be built"):
        build(Quadratic, {})
