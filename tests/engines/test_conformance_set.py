"""The conformance set for simulators: its numbers are found again, right engines are right, and planted faults are named."""

import dataclasses
import importlib
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import conformance_set
import numpy as np
import pytest

import bench
from bench.cli import main
from bench.engines import conformance, table
from bench.engines.conformance import runner
from bench.experiment import config

pytest.importorskip("mujoco")
ROOT = Path(__file__).resolve().parents[2]
FEW = ("connect_fast", "stacked", "impratio")
SMALL = ("slide_limit", "elliptic_slide")
"""Cases of a limit and of friction."""
STORED = 1e-5
"""Relative difference from stored numbers allowed: faults come from single differences of terms, and add up over steps."""


def mjx(**settings):
    pytest.importorskip("mujoco.mjx")
    return importlib.import_module("bench.plugins.engines.mjx_conformance").Engine(**settings)


def blocks():
    """Return the programs on the page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / "docs/conformance.md").read_text(), re.DOTALL)


def pytest_in(folder, *words):
    """Return what pytest prints in a folder, which is on the path."""
    alone = os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(folder)}  # hydra brings a plugin
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    return subprocess.run(words, cwd=folder, env=alone, capture_output=True, text=True).stdout


def wrong(rows):
    return [row for row in rows if not row["is_right"]]


def test_an_engine_that_follows_the_page_runs_without_this_package(tmp_path):
    """The page's engine has 40 lines at most, in a folder with a copy of the set."""
    (tmp_path / "tests").mkdir()
    shutil.copytree(Path(conformance.__file__).parent, tmp_path / "tests" / "conformance")
    engine, test, *_ = blocks()
    assert len(engine.splitlines()) <= 41
    (tmp_path / "tests" / "my_engine.py").write_text(engine)
    text = (
        "import sys\n"
        + test
        + "\n\ndef test_alone():\n    assert not {'hydra', 'pandas', 'bench'} & set(sys.modules)\n"
    )
    (tmp_path / "tests" / "test_mine.py").write_text(text)
    text = pytest_in(tmp_path, "tests")
    assert "2 passed" in text, text
    words = [sys.executable, "tests/conformance/runner.py", "tests/my_engine.py", "friction_loss"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    _, *rows = map(json.loads, done.stdout.splitlines())
    assert [row["term"] for row in rows] == ["value", *conformance_set.TERMS]
    assert all(row["is_right"] and row["digits"] > 10 for row in rows)


def test_the_set_in_a_new_folder_has_an_item_per_case_and_derivative(tmp_path):
    assert main(["engines", "set", str(tmp_path)]) == 0
    assert (tmp_path / "conformance" / "VERSION").read_text() == f"{bench.__version__}\n"
    assert main(["engines", "set", str(tmp_path)]) == 2
    (tmp_path / "my_engine.py").write_text(blocks()[0].replace('"parameter": by_p', '"parameter": -by_p'))

    def run():
        return pytest_in(tmp_path, "-rfsx", "-p", "conformance.plugin", "my_engine.py")

    text, n = run(), len(conformance.cases())
    assert f"1 failed, 5 passed, {5 * (n - 1)} skipped" in text
    assert "friction_loss-parameter - AssertionError: -1 times" in text
    (tmp_path / "xfails.txt").write_text("friction_loss-parameter  # the sign\n")
    assert f"5 passed, {5 * (n - 1)} skipped, 1 xfailed" in run()
    (tmp_path / "xfails.txt").write_text("friction_loss-qpos  # repaired\nfriction_loss-parameter\n")
    assert f"1 failed, 4 passed, {5 * (n - 1)} skipped, 1 xfailed" in run()
    (tmp_path / "xfails.txt").write_text("friction_los\n")
    assert "names friction_los, which is not a case or CASE-TERM" in run()
    (tmp_path / "xfails.txt").unlink()
    (tmp_path / "my_engine.py").write_text(WITHOUT_DERIVATIVES.lstrip())  # with the class in its first line
    text = run()
    assert f"1 failed, {n} passed, {4 * n} skipped" in text
    assert "::judged - AssertionError: 0 derivatives are judged" in text


WITHOUT_DERIVATIVES = """

class Engine:
    def rollout(self, case):
        return case.data["expected"]["value"]

    def gradient(self, case):
        return {}
"""


class OwnPhysics:
    """An engine with another law, whose derivative by the controls lacks a factor."""

    differs = {"free_joint": "another law"}

    @staticmethod
    def rollout(case):
        return float(np.sin(case.qpos).sum() * case.parameter + (case.controls**3).sum())

    @staticmethod
    def gradient(case):
        return {"qpos": np.cos(case.qpos) * case.parameter, "controls": 2 * case.controls**2}


def test_physics_that_differ_by_design_are_compared_with_their_own_differences():
    value, qpos, controls = conformance.run(OwnPhysics(), "free_joint")
    assert (value["is_right"], value["reason"]) == (None, "another law")
    assert (qpos["is_right"], qpos["against"]) == (True, "own differences")
    assert qpos["digits"] > 8
    assert controls["is_right"] is False
    assert not controls["looks_like"]


class Short:
    """A pendulum with states of short floats, a cost of float64 and the right derivative."""

    differs = {"hinge_limit": "no limit"}
    tolerance = "float32"

    def __init__(self, kind=np.float32):
        self.kind = kind

    def rollout(self, case):
        q, v, dt, gravity = map(self.kind, (case.qpos[0], case.qvel[0], 0.02, 9.81))
        for _ in range(20):
            v = v - dt * gravity * np.sin(q)
            q = q + dt * v
        return case.cost(float(q), float(v))

    def gradient(self, case):
        long = Short(np.float64)
        return {term: case.differences(long, term)[0] for term in ("qpos", "qvel")} | {"parameter": 0.0}


def test_shorter_floats_than_those_of_the_cost_are_no_fault():
    (case,) = conformance.cases("hinge_limit")
    for shift in np.linspace(-0.5, 0.5, 40):
        moved = dataclasses.replace(case, qpos=case.qpos + shift)
        _, *rows = conformance.check(Short(), moved)
        assert not [row for row in rows if row["is_right"] is False], rows
        assert [row["is_right"] for row in rows].count(True) >= 2


class Planted:
    """The set's numbers, the derivatives by one term, by default qpos, changed by a function."""

    tolerance = "float64"

    def __init__(self, change, term="qpos"):
        self._change, self._term = change, term

    def rollout(self, case):
        return case.data["expected"]["value"]

    def gradient(self, case):
        numbers = {term: np.array(case.data["expected"][term]) for term in runner.TERMS}
        return numbers | {self._term: self._change(numbers[self._term], numbers)}


@pytest.mark.parametrize(
    ("change", "reason", "at"),
    [
        (lambda by, all: 0.0 * by, "0", "free_joint qpos"),
        (lambda by, all: all["qvel"], "the numbers of qvel", "weld qpos"),
        (lambda by, all: by[[3, 4, 5, 0, 1, 2]], "in the order [3, 4, 5, 0, 1, 2]", "elliptic_slide qpos"),
        (lambda by, all: np.append([0, 0], by[:-2]), "shifted by +1", "offset_slide controls"),
        (lambda by, all: np.append(by[:-1], 0.0), "qpos[5]: 0", "free_joint qpos"),
        (lambda by, all: np.abs(by), "qpos[1]: -1 times", "offset_slide qpos"),
        (lambda by, all: by + np.array([0, 0, 0.5, 0, 0, 0.2]), "qpos[2, 5]: 0.71 instead of 0.21", "free_joint qpos"),
        (lambda by, all: 1e-3 * by[::-1], "qpos[2]: 0.00989847 instead of 75.6466", "weld qpos"),
        (lambda by, all: np.inf * by, "12 of 12 numbers not finite", "weld qpos"),
    ],
)
def test_a_wrong_derivative_has_a_reason_that_is_true(change, reason, at):
    """Small numbers are not a factor times the right ones, and one large number does not hide the others."""
    case, term = at.split()
    rows = conformance.run(Planted(change, term), case)
    (row,) = (row for row in rows if not row["is_right"])
    assert (row["term"], row["reason"], row["looks_like"]) == (term, reason, "")
    assert len(rows) == 5
    json.dumps(row, allow_nan=False)


@pytest.mark.parametrize(
    ("factor", "doubt", "is_right"),
    [(-1, 0.1, False), (0.5, 0.1, False), (0, 0.1, False), (0.9, 0.1, None), (1, 0.1, None), (1, 1e-4, True)],
)
def test_a_derivative_off_by_more_than_its_uncertainty_is_wrong(factor, doubt, is_right, monkeypatch):
    """Also if the engine's own differences are uncertain by more than 1%. The largest component is 2.04."""
    engine = Planted(lambda by, all: factor * by)
    engine.differs = {"free_joint": "another law"}
    own = lambda case, engine, term: (np.array(case.data["expected"][term]), doubt)  # noqa: E731
    monkeypatch.setattr(runner.Case, "differences", own)
    _, row, *_ = conformance.run(engine, "free_joint")
    assert row["is_right"] is is_right


def test_rows_have_the_numbers_that_are_compared():
    (case,) = conformance.cases("free_joint")
    _, row, *_ = conformance.check(Planted(lambda by, all: 0.5 * by), case)
    assert (row["component"], row["expected"], row["obtained"], row["ratio"]) == (1, 2.04, 1.02, 0.5)
    assert row["uncertainty"] == case.data["certainty"]["qpos"]
    assert tuple(row) == runner.COLUMNS


def test_an_engine_without_derivatives_fails():
    engine = Planted(lambda by, all: by)
    conformance.verify(conformance.run(engine, "free_joint"), judged=4)
    with pytest.raises(AssertionError, match=re.escape("4 derivatives are judged, 5 are required")):
        conformance.verify(conformance.run(engine, "free_joint"), judged=5)
    with pytest.raises(AssertionError, match="free_joint qpos: -1 times"):
        conformance.verify(conformance.run(Planted(lambda by, all: -by), "free_joint"))


@pytest.mark.parametrize(
    ("script", "words", "status", "text"),
    [
        (
            runner,
            ["mine.py", "free_join"],
            1,
            "there is no case 'free_join', did you mean free_joint?; cases: ball_limit,",
        ),
        (runner, [], 1, "Runs the conformance set on an engine"),
        (runner, ["nofile.py"], 1, "nofile.py: No such file or directory"),
        (conformance.metamorphic, ["mine.py", "model.xml"], 1, "mine.py has no class Model"),
        (conformance.metamorphic, ["mine.py", "model.xml", "dense"], 1, "'dense' is not a property or a setting"),
        (runner, ["mine.py", "rk4"], runner.WRONG, "0 derivatives are judged, 1 are required"),
    ],
)
def test_what_a_script_cannot_run_is_said_in_a_line(tmp_path, script, words, status, text):
    (tmp_path / "mine.py").write_text(WITHOUT_DERIVATIVES)
    words = [sys.executable, script.__file__, *words]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == status
    assert done.stderr.startswith(text)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("gradient", lambda case: {"qvel": [0.0]}, "1 numbers instead of 2"),
        ("gradient", lambda case: {"ctrl": [0.0]}, "ValueError: 'ctrl' is not one of qpos, qvel, controls, parameter"),
        ("gradient", lambda case: 1 / 0, "ZeroDivisionError: division by zero"),
        ("tolerance", "single", "ValueError: tolerance='single' is not a number or one of float64, float32"),
    ],
    ids=["too few numbers", "another name", "an error", "a tolerance"],
)
def test_what_an_engine_does_wrong_is_a_row(name, value, reason):
    engine = OwnPhysics()
    setattr(engine, name, value)
    *_, row = conformance.run(engine, "rk4")
    assert (row["is_right"], row["reason"]) == (False, reason)


def test_an_engine_that_writes_into_a_case_spoils_no_derivative():
    class InPlace(Planted):
        def rollout(self, case):
            case.qpos[:] += 1.0
            return super().rollout(case)

        def gradient(self, case):
            (other,) = conformance.cases(case.name)
            return {"qpos": super().gradient(case)["qpos"] * (case.qpos == other.qpos).all()}

    assert not wrong(conformance.run(InPlace(lambda by, all: by), "free_joint"))


@pytest.mark.parametrize(
    ("fault", "case", "engine"),
    [
        *(
            (fault, case, conformance_set.ByTerms(fault))
            for fault, case in {
                "sign of equality": "joint_equality",
                "dropped J-dot v": "weld",
                "frozen normal": "stacked",
                "stale velocity": "ball_limit",
            }.items()
        ),
        ("one iteration", "pyramidal_slide", conformance_set.MujocoC(iterations=1)),
        ("impratio ignored", "impratio", conformance_set.MujocoC(impratio=1.0)),
    ],
)
def test_a_planted_fault_is_named(fault, case, engine):
    found = wrong(conformance.run(engine, case))
    assert found
    assert {row["looks_like"] for row in found} == {fault}


def test_every_case_has_sources_that_agree():
    cases = conformance.cases()
    assert len(cases) == 35
    for case in cases:
        sources = case.data["sources"]
        assert len(sources) >= 2, case.name
        assert max(error for source in sources.values() for error in source.values()) < STORED, case.name
    faults = {fault for case in cases for fault in case.data["faults"]}
    assert faults == {*conformance_set.BY_TERMS, "one iteration", "one iteration of MJX", "impratio ignored"}


@pytest.mark.parametrize("name", ["condim1", *(pytest.param(name, marks=pytest.mark.slow) for name in FEW)])
def test_a_case_written_again_has_the_stored_numbers(name):
    (case,) = conformance.cases(name)
    again = conformance_set.numbers(case)
    pairs = [(again["expected"], case.data["expected"])]
    pairs += [(numbers, case.data["faults"][fault]) for fault, numbers in again["faults"].items()]
    for new, old in pairs:
        assert new.keys() == old.keys()
        for term, number in old.items():
            np.testing.assert_allclose(new[term], number, rtol=0, atol=STORED * np.abs(number).max(), err_msg=term)


def test_motors_of_a_free_body_with_joints_push_the_body():
    without_motors = runpy.run_path(ROOT / "plugins/engines/free_bodies.py")["without_motors"]
    chain, tendon = conformance.cases("sparse_chain", "spatial_tendon")
    assert without_motors(chain)[1].nonzero()[0].tolist() == [0]
    with pytest.raises(NotImplementedError, match="motors of tendons"):
        without_motors(tendon)


@pytest.mark.slow
def test_the_c_engine_is_right():
    rows = conformance.run(conformance_set.MujocoC())
    assert not wrong(rows)
    assert len(rows) == 5 * len(conformance.cases())


# --------------------------------------------------------------------------------------------------------- MJX


@pytest.mark.parametrize(
    "names", [pytest.param(SMALL, marks=pytest.mark.slow), pytest.param((), marks=pytest.mark.full)], ids=["few", "all"]
)
def test_mjx_is_right(names):
    names = names or [case.name for case in conformance.cases()]
    rows = conformance.run(mjx(), *names)
    assert {row["case"] for row in rows if row["is_right"] is None} == {
        "box_tilted",
        "connect",
        "connect_fast",
        "sparse_chain",
        "weld",
    } & set(names)
    assert not [row for row in rows if row["is_right"] is False]


@pytest.mark.slow
def test_a_fault_planted_in_mjx_is_named(monkeypatch):
    import jax
    from mujoco.mjx._src import collision_driver

    collide = collision_driver.collision

    def frozen(model, data):
        data = collide(model, data)
        return data.tree_replace({"_impl.contact.frame": jax.lax.stop_gradient(data._impl.contact.frame)})

    monkeypatch.setattr(collision_driver, "collision", frozen)
    found = [row for row in wrong(conformance.run(mjx(), "stacked")) if row["term"] != "parameter"]
    assert {row["looks_like"] for row in found} == {"frozen normal"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "settings", "fault", "terms"),
    [
        ("pyramidal_slide", {"is_implicit": False, "iterations": 1}, "one iteration of MJX", ("value", "controls")),
        ("weld", {}, "dropped J-dot v", ("qpos", "qvel")),
    ],
)
def test_what_mjx_lacks_is_named(case, settings, fault, terms):
    """Were J-dot v repaired, the documentation and the engine's file would be wrong."""
    engine = mjx(**settings)
    engine.differs = {}
    found = {row["term"]: row["looks_like"] for row in wrong(conformance.run(engine, case))}
    assert {found[term] for term in terms} == {fault}


# -------------------------------------------------------------------------------------------------------- table


UNFINISHED = """
import os


class Engine:
    versions = {"mine": "2"}

    def rollout(self, case):
        if case.name != "rk4":
            os._exit(3)
        return 0.0

    def gradient(self, case):
        return {}
"""


def test_rows_of_an_engine_that_ends_stay_with_the_reason(tmp_path):
    (tmp_path / "mine_conformance.py").write_text(UNFINISHED)
    row, last = table.run(sys.executable, runner, str(tmp_path / "mine_conformance.py"), "rk4", "weld")
    assert (row["versions"], row["case"], row["is_right"]) == ("mine 2", "rk4", False)
    assert "exit status 3" in last["reason"]


def test_the_table_keeps_other_releases(tmp_path, monkeypatch):
    """A column per release, verdicts that changed between them, and a release that runs again replaces its rows."""
    monkeypatch.setattr(table.subprocess, "run", lambda *words, **options: None)
    for version, is_right, digits in (("3.1", True, 1.0), ("3.2", True, 2.0), ("3.1", False, 3.0)):
        row = {
            "versions": f"mujoco {version}; x 1",
            "case": "rk4",
            "is_right": is_right,
            "digits": digits,
            "term": "qvel",
        }
        row |= {"reason": "" if is_right else "-1 times", "looks_like": "" if is_right else "a fault", "seconds": 1}
        monkeypatch.setattr(table.Engine, "rows", lambda *of, row=row: [row])
        page = table.write([table.Engine("mujoco")] * 2, tmp_path).read_text()
    assert "| case | mujoco 3.1 | mujoco 3.2 |" in page
    assert "| rk4 | 3.0 wrong: qvel (a fault) | 2.0 |" in page
    assert (
        "| case | term | mujoco 3.1 | mujoco 3.2 |\n| --- | --- | --- | --- |\n| rk4 | qvel | wrong | right |" in page
    )
    assert "- mujoco 3.1, rk4 qvel: -1 times" in page


def test_two_releases_have_a_folder_that_settings_can_name(tmp_path, monkeypatch):
    """Its name has a comma, which settings read in quotes only."""
    commands = []
    monkeypatch.setattr(table.subprocess, "run", lambda words, **options: commands.append(words))
    monkeypatch.setattr(table.Engine, "rows", lambda self, *of: [{"versions": f"mujoco {self.release}", "case": "rk4"}])
    table.write([table.Engine("mujoco"), table.Engine("mujoco==4.0.0")], tmp_path)
    assert "mujoco-4.0.0" in str(config.load(commands[0][3:]).results_dir)


@pytest.mark.slow
def test_the_table_has_versions_digits_and_commands(tmp_path):
    settings = "scenes=[bounce_once] contacts=[penalty] samples=2 repeats=2 reference.samples=256 workers=0"
    assert main(["engines", "table", "mujoco", f"out={tmp_path}", *settings.split()]) == 0
    page = (tmp_path / "engines.md").read_text()
    assert "| mujoco | mujoco 3." in page
    assert "`python -m bench engines table mujoco`" in page
    assert "| stacked | " in page
    assert "bounce_once" in page
    assert len((tmp_path / "engines.csv").read_text().splitlines()) > 5 * 35
