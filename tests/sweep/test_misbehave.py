"""The bank of misbehaving plugins is whole; ``misbehave.py`` runs as many of them as are asked for."""

import os
import subprocess
import sys

import misbehave
import pytest


def test_the_bank_holds_every_kind_place_and_fault():
    cases = misbehave.bank()
    assert len(cases) == len({case.name for case in cases}) > 800
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
