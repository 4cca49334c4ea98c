"""Gradient checks: each planted fault gets its name, right gradients get none, and the command says so."""

import json

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.gradient_check import GradientCheck, is_trusted, measure
from bench.plugins.studies.gradient_check.views import by_point

from bench import cli, run
from bench.cli import main
from bench.experiment import grid
from bench.experiment.columns import IDENTITY
from bench.gradient import FAULTS, TRUSTED, VERDICTS
from bench.measure import noise
from bench.model import Problem, compose, registry

FLOAT64, FLOAT32 = (float(np.finfo(dtype).eps) for dtype in (np.float64, np.float32))


def plugin(kind, name, **values):
    return registry.make(kind, name, values)


SEARCH = GradientCheck()
"""Where the study looks by default."""


def compiled(scene, contact=None, backend="jax", dtype="float64"):
    program = compose(scene, contact, plugin("integrators", "semi_implicit_euler"))
    return plugin("backends", backend, dtype=dtype).compile(program)


class Planted(Problem):
    """A problem whose costs and gradients pass through functions."""

    def __init__(self, problem, value=lambda f, theta: f, grad=lambda g, theta: g):
        super().__init__(problem.program)
        self._inner, self._on_value, self._on_grad = problem, value, grad

    def _value(self, theta, w):
        return self._on_value(self._inner.value(theta, w), theta)

    def _grad(self, theta, w):
        return self._on_grad(self._inner.grad(theta, w), theta)

    def _score(self, theta, w):
        raise NotImplementedError


def verdicts(problem, unit=FLOAT64):
    """The verdicts of a problem's checks by point."""
    scene = problem.program.scene
    drawn = noise.draw(0, scene.name, 1, 1, problem.program.n_noise, "test")[0, 0]
    directions = noise.draw(0, scene.name, 1, SEARCH.drawn, problem.dim, "test directions")[0]
    told = {}
    for point in measure.examine(problem, drawn, directions, unit, SEARCH):
        told.setdefault(point.place.point, set()).add(point.verdict)
    return told


@pytest.fixture(scope="module")
def pendulum():
    return compiled(plugin("scenes", "pendulum", horizon=10))


@pytest.fixture(scope="module")
def bounce():
    """A ball that meets the ground in the 10 steps, between two of them."""
    scene = plugin("scenes", "bounce_once", horizon=10, height=0.1 + 5.3 * 2.0 / 480.0)
    return compiled(scene, plugin("contacts", "penalty", stiffness=1e4))


# ------------------------------------------------------------------------------------------------ planted faults


def test_wrong_adjoint_beside_a_contact_switch_and_on_it(bounce):
    told = verdicts(Planted(bounce, grad=lambda g, _: -g))
    assert set(told) == {"start", "before", "at", "after"}
    assert all(names == {"wrong_adjoint"} for names in told.values())


@pytest.mark.parametrize("of", ["value", "grad"])
@pytest.mark.parametrize(("size", "is_repeated"), [(2, True), (1000, False)])
def test_the_last_digits_of_equal_calls_may_differ(pendulum, of, size, is_repeated):
    """Threads add up in any order, so that equal calls of MJX differ by a few units in the last place."""
    generator = np.random.default_rng(0)

    def last(f, _):
        return f + size * generator.integers(-1, 2, f.shape) * np.spacing(f)

    check = measure.start(Planted(pendulum, **{of: last}), pendulum.program.theta0, FLOAT64, SEARCH, 0)
    assert (check.cause != "nondeterministic") == is_repeated


@pytest.mark.parametrize(("factor", "is_right"), [(1.0, True), (1.0001, False)])
def test_a_gradient_by_differences_is_held_to_their_precision(factor, is_right):
    """Beside a contact that switches within the step, the smallest of 50 components is off by 5e-4 of itself."""
    problem = compiled(plugin("scenes", "pushing", horizon=50), plugin("contacts", "penalty"), backend="numpy")
    planted = Planted(problem, grad=lambda g, _: factor * g)
    planted.step = problem.step
    check = measure.start(planted, problem.program.theta0, FLOAT64, SEARCH, 0)
    assert (check.cause in TRUSTED) == is_right, check.sentence()


def test_wrong_adjoint_is_seen_in_float32(pendulum):
    single = compiled(pendulum.program.scene, dtype="float32")
    assert verdicts(Planted(single, grad=lambda g, _: 2.0 * g), FLOAT32) == {"start": {"wrong_adjoint"}}


def test_switch_of_a_penalty_contact_is_a_kink_between_two_crossings(bounce):
    told = verdicts(bounce)
    assert told["before"] == told["after"] == {"mode_crossing"}
    assert told["at"] == {"kink"}
    assert not told["start"] & set(FAULTS)


@pytest.fixture(scope="module")
def exploding():
    """Bodies pushed together with a spring so stiff that each step in contact multiplies the state."""
    return compiled(plugin("scenes", "pushing", horizon=50), plugin("contacts", "penalty", stiffness=1e4))


def test_switch_in_an_exploding_rollout_is_no_fault(exploding):
    """Its one-sided slopes settle at the smallest steps only, and the gradient is one of them."""
    told = verdicts(exploding)
    assert told["at"] <= {"kink", "unsettled"}
    assert "kink" in told["at"]
    assert not set.union(*told.values()) & set(FAULTS)


@pytest.mark.parametrize(("factor", "name"), [(-1.0, "wrong_adjoint"), (0.5, "wrong_adjoint"), (0.0, "disconnected")])
def test_faults_are_seen_at_the_switch_of_an_exploding_rollout(exploding, factor, name):
    told = verdicts(Planted(exploding, grad=lambda g, _: factor * g))
    assert told["at"] == {name}


def test_rollout_that_explodes_beyond_differences_tells_nothing():
    """Over 100 steps the gradient is 3e18 and no step is small enough to see it: not a fault, and not trusted either."""
    problem = compiled(plugin("scenes", "pushing", horizon=100), plugin("contacts", "penalty", stiffness=1e4))
    assert verdicts(problem)["at"] == {"unsettled"}


def test_switch_of_a_damped_contact_is_a_jump():
    law = plugin("contacts", "penalty", stiffness=50.0, damping=1.0, damping_mode="linear")
    told = verdicts(compiled(plugin("scenes", "wall_penalty_1d", horizon=10, start=0.05), law))
    assert told["at"] == {"jump"}


# ------------------------------------------------------------------------------------------------- contact modes


@pytest.mark.parametrize("law", ["penalty", "impulse"])
def test_every_kind_of_law_shows_when_it_acts(bounce, law):
    """A ball 5.3 steps above the ground, at 1 step's worth a step, is first pushed in step 5 or the one after."""
    problem = compiled(bounce.program.scene, plugin("contacts", law), "implicit")
    modes = measure.contact_modes(problem)
    (name,) = modes(problem.program.theta0[:, None], np.zeros((3, 1)))
    first = {"penalty": "6-9", "impulse": "5"}
    assert name == first[law] if law in first else name.startswith("5")


# -------------------------------------------------------------------------------------------------- the command

TINY = ["contacts=[penalty]", "backends=[numpy]", "sweep.horizon=[1,5]", "workers=0"]


def test_command_writes_files_and_exits_with_0(tmp_path, capsys):
    words = ["gradcheck", "bounce_once", *TINY, "formats=[png]", f"results_dir={tmp_path}"]
    assert main(words) == 0
    assert "beside" in capsys.readouterr().out  # a kink on a switch is not trusted there
    directory = tmp_path / "gradcheck"
    for name in ("gradient_check.csv", "gradient_check.md", "gradient_check.png"):
        assert (directory / name).stat().st_size > 0
    table = pd.read_csv(directory / "gradient_check.csv")
    assert {*IDENTITY, "point", "direction", "eps", "derivative_program", "derivative_differences"} <= set(
        table.columns
    )
    assert set(table["point"]) == {"start", "before", "at", "after"}
    assert set(table["verdict"]) <= set(VERDICTS)
    assert (table["status"] == "ok").all()
    assert set(table["horizon"]) == {1, 5}
    assert json.loads((directory / "run.json").read_text())["study"] == "gradient_check"


@pytest.mark.parametrize(
    "words",
    [
        ["bounce_once", "scene.bounce_once.horizon=7"],
        ["bounce_once", "+scene.bounce_once.horizon=7"],
        ["bounce_once", "scene={bounce_once:{horizon:7}}"],
        ["bounce_once[horizon=7]"],
    ],
)
def test_a_given_number_of_steps_is_the_only_one(words, monkeypatch):
    seen = []
    monkeypatch.setattr(cli, "_execute", lambda experiment, _: seen.extend(grid.cells(experiment)) or 0)
    assert main(["gradcheck", *words]) == 0
    assert {cell.scene.horizon for cell in seen} == {7}


def test_contacts_of_an_engine_are_asked_from_the_engine(bounce, monkeypatch):
    """An engine's steps cannot be taken in NumPy, and some of its contacts are known to the engine only."""
    problem = compiled(bounce.program.scene, bounce.program.contact, "mujoco")
    problem.provides = problem.provides | {"physics"}
    modes = measure.contact_modes(problem)
    assert modes(problem.program.theta0[:, None], np.zeros((3, 1))) == ["6-9"]
    box = compiled(plugin("scenes", "tossed_box", horizon=2), plugin("contacts", "penalty"), "mujoco")
    box.provides = box.provides | {"physics"}
    modes = measure.contact_modes(box)
    assert len(modes.names) == 4
    assert modes(box.program.theta0[:, None], np.zeros((box.program.n_noise, 1))) == ["-;-;-;-"]
    monkeypatch.delattr(type(box), "engine_contacts")
    assert measure.contact_modes(box) is None


@pytest.mark.slow
def test_step_beyond_the_stability_limit_is_said(tmp_path, capsys):
    words = ["contacts=[penalty]", "backends=[numpy]", "sweep.horizon=[2]", "workers=0", "formats=[]"]
    main(["gradcheck", "pushing", *words, "contact.penalty.stiffness=1e4", f"results_dir={tmp_path}"])
    assert "beyond the stability limit" in capsys.readouterr().out
    main(["gradcheck", "pushing", *words, "contact.penalty.stiffness=10", f"results_dir={tmp_path}"])
    assert "beyond the stability limit" not in capsys.readouterr().out


@pytest.mark.parametrize("verdict", ["unsettled", "jump", "kink", "nan_gradient", "wrong_factor", "staircase"])
def test_what_cannot_be_trusted_counts_except_what_was_sought_on_a_switch(verdict):
    assert not is_trusted("start", verdict)
    assert is_trusted("at", verdict) == (verdict in ("jump", "kink"))


def test_gradient_that_is_right_for_the_first_column_alone_is_seen(pendulum):
    def later(g, _):
        return np.concatenate([g[:, :1], 1.1 * g[:, 1:]], axis=1)

    found = measure.start(Planted(pendulum, grad=later), pendulum.program.theta0, FLOAT64, SEARCH, 0)
    assert found.cause == "wrong_factor"


def test_components_are_columns_of_the_row(tmp_path):
    words = ["study=gradient_check", "scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "formats=[]"]
    rows = run([*words, "workers=0", "name=one", f"results_dir={tmp_path}"])
    (row,) = rows.to_dict("records")
    assert list(row["component"]) == list(range(int(row["dim"])))
    np.testing.assert_allclose(row["component_ratio"], 1.0, rtol=1e-6)
    np.testing.assert_allclose(row["component_program"], row["component_difference"], rtol=1e-6)
    assert set(row["component_verdict"]) == {"smooth"}
    assert row["untrusted"] == 0


def test_worst_check_decides_the_line_of_a_point():
    rows = pd.DataFrame(
        [
            GradientCheck.columns.blank()
            | {
                "point": ["start", "start"],
                "check_verdict": ["smooth", "wrong_adjoint"],
                "check_error": [1e-9, 0.5],
                "check_eps": [1e-5, 1e-6],
                "key": "k",
                "sample": [0, 0],
                "direction": [0, 1],
                "derivative_program": [1.0, 1.0],
            }
        ]
    )
    (line,) = by_point(rows).to_dict("records")
    assert (line["verdict"], line["error"]) == ("wrong_adjoint", 0.5)
