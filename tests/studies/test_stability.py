"""The stability map: verdicts, boundaries against theory, and the files made from them."""

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies import stability
from bench.plugins.studies.stability import Stability
from helpers import loaded, unmeasured

from bench.errors import Unsupported
from bench.model import MechanicalScene, State, registry
from bench.run import tasks
from bench.run.session import RunSession

STIFFNESS = tuple(float(k) for k in np.logspace(1, 4, 13))
HORIZON, DT = 40, 0.05


def cells_of(*words):
    """The experiment of a command line, and its cells."""
    return loaded("study=stability", "estimators=[fobg]", "backends=[implicit]", *words)


def measured(*words):
    """The measured rows of a command line."""
    given, cells = cells_of(*words)
    session = RunSession(given)
    return pd.DataFrame([cell.columns() | tasks.measure_cell(cell, session, cell.study) for cell in cells])


def swept(integrator, *words):
    """Rows of mass_spring over STIFFNESS at one dt, which compiles once."""
    return measured(
        "scenes=[mass_spring]",
        f"integrators=[{integrator}]",
        f"sweep.stiffness={list(STIFFNESS)}",
        f"scene.mass_spring.horizon={HORIZON}",
        f"scene.mass_spring.dt={DT}",
        *words,
    )


def agrees(rows):
    """Whether the limit in theory is within one cell of the grid of the measured one, at the only dt."""
    lost = rows["verdict"].isin(["diverged", "nonfinite"]) | (rows["growth_factor"] > 1 + 1e-9)
    stable, unstable = rows.loc[~lost.cummax(), "stiffness"].max(), rows.loc[lost, "stiffness"].min()
    step = STIFFNESS[1] / STIFFNESS[0]
    low = stable / step if stable > STIFFNESS[0] else 0.0
    high = unstable * step if unstable < STIFFNESS[-1] else math.inf
    return low <= rows["stiffness_limit"].median() <= high


@dataclass(frozen=True)
class Drop(MechanicalScene):
    """A mass thrown at unit speed; f = q_N. It has no physical gradient."""

    name = "drop"
    n_q = 1
    slope: float = 1.0

    def theta0(self):
        return np.array([0.5, 1.0])

    def initial_state(self, xp, theta):
        return State(theta[0:1], theta[1:2])

    def acceleration(self, xp, q, v, u):
        return -0.1 * v

    def terminal_cost(self, xp, q, v):
        return self.slope * q[0]


LIMITS = Stability()


@pytest.mark.parametrize(
    "integrator",
    [
        name
        if name in ("semi_implicit_euler", "midpoint", "implicit_euler")
        else pytest.param(name, marks=pytest.mark.slow)
        for name in sorted(registry.entries()["integrators"])
    ],
)
def test_measured_boundary_is_within_a_cell_of_the_theoretical_one(integrator):
    """For every integrator, those too that grow too slowly to diverge within the rollout."""
    rows = swept(integrator)
    assert agrees(rows)
    assert rows["growth_factor"].to_numpy() == pytest.approx(rows["spectral_radius"].to_numpy(), rel=1e-6)


def test_growth_of_ten_percent_is_divergence():
    """A state that doubles in 20 steps stays within 10 times its scale, and is bad where it has grown by a tenth."""
    growth = 2 ** (1 / 20)
    states = 0.1 * growth ** np.arange(21)[:, None]
    step, verdict, reason = stability.first_bad_step(states, np.ones(1), growth, LIMITS)
    assert (step, verdict) == (math.ceil(20 * math.log2(1.1)), "diverged")
    assert "10%" in reason
    assert stability.first_bad_step(states, np.ones(1), 1.0, LIMITS) is None
    assert stability.first_bad_step(states, np.ones(1), math.nan, LIMITS) is None
    far = np.array([[0.5], [1.0], [-1.01]])
    assert stability.first_bad_step(far, np.ones(1), 1.0, LIMITS)[:2] == (2, "diverged")


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_growth_does_not_depend_on_the_unit_of_a_speed(unit):
    """A spiral: a position of 1.02^k cos(k) and a speed of 1.02^k sin(k) grow by 2% a step."""
    at = np.arange(20.0)
    states = 1.02 ** at[:, None] * np.stack([np.cos(at), unit * np.sin(at)], axis=1)
    assert stability.growth_factor(states) == pytest.approx(1.02, rel=1e-9)


@pytest.mark.parametrize("backend", ["jax", "torch", "numpy"])
def test_backends_without_step_jacobians_are_classified_alike(backend):
    words = [f"backends=[{backend}]", "contacts=[penalty]", "integrators=[semi_implicit_euler]"]
    sweep = ["scenes=[mass_spring,bouncing_ball]", "sweep.stiffness=[1e2,1e4]", "scene.mass_spring.damping=1"]
    scenes = [
        f"scene.{name}.{value}" for name in ("mass_spring", "bouncing_ball") for value in ("horizon=20", "dt=0.05")
    ]
    rows = measured(*words, *sweep, *scenes)
    assert list(rows["verdict"]) == ["inaccurate", "wrong_sign", "diverged", "diverged"]
    assert all(rows["reason"][2:])
    assert rows["growth_factor"][0] == pytest.approx(rows["spectral_radius"][0], abs=1e-9)


@pytest.mark.parametrize(
    ("gradient", "truth", "verdict"),
    [
        ([1.0, 2.0], [1.0, 2.0], "ok"),
        ([1.05, 2.1], [1.0, 2.0], "ok"),
        ([1.3, 2.0], [1.0, 2.0], "inaccurate"),
        ([-1.0, -2.0], [1.0, 2.0], "wrong_sign"),
        ([0.0, 2.0], [1.0, 2.0], "zero"),
        ([0.0, 0.0], [1.0, 2.0], "zero"),
        ([0.0, 0.0], [0.0, 0.0], "ok"),
        ([1.0, 0.0], [1.0, 0.0], "ok"),
    ],
)
def test_verdicts(gradient, truth, verdict):
    """A component of 0 is a verdict only where the truth's is not."""
    assert stability.compare(np.array(gradient), np.array(truth), LIMITS.inaccurate)["verdict"] == verdict


def test_truth_is_refined_where_there_is_no_physical_gradient():
    """q_N = q_0 + v_0 (1 - e^(-T/10)) 10, whose Euler error is about dt T / 20 of the second component."""
    given, (cell,) = cells_of("scenes=[mass_spring]", "integrators=[semi_implicit_euler]", "backends=[jax]")
    row = LIMITS.measure(cell.with_part("scene", Drop(horizon=10, dt=0.1)), RunSession(given))
    assert row["truth"] == "refined"
    assert row["verdict"] == "ok"
    truth = math.hypot(1.0, 10 * (1 - math.exp(-0.1)))
    assert row["truth_norm"] == pytest.approx(truth, rel=1 / LIMITS.fine_steps)
    assert row["truth_error"] < 1 / LIMITS.fine_steps


def test_a_truth_that_still_moves_by_half_the_limit_of_an_error_is_not_resolved():
    """One step multiplies the speed by 0.9, and two by 0.95 each: positions of 0.9, and 0.5 (0.95 + 0.9025) = 0.92625."""
    given, (cell,) = cells_of("scenes=[mass_spring]", "integrators=[semi_implicit_euler]", "backends=[jax]")
    row = Stability(fine_steps=2, finer=1, inaccurate=0.03).measure(
        cell.with_part("scene", Drop(horizon=1, dt=1.0)), RunSession(given)
    )
    assert row["truth_error"] == pytest.approx(0.02625 / math.hypot(1.0, 0.92625))
    assert row["verdict"] == "unresolved"


def test_finer_steps_lose_as_much_speed_in_a_second():
    _, (cell,) = cells_of(
        "scenes=[mass_spring]", "scene.mass_spring.horizon=2", "scene.mass_spring.velocity_factor=0.81"
    )
    fine = stability._refined(cell, 4).scene
    assert (fine.dt, fine.velocity_factor) == (cell.scene.dt / 2, pytest.approx(0.9))


def test_scenes_without_time_steps_are_unsupported():
    (row,) = measured("scenes=[quadratic]", "backends=[jax]").to_dict("records")
    assert row["status"] == "unsupported"
    assert "no time steps" in row["reason"]


@pytest.mark.parametrize("words", [(), (f"theta0={[0.1] * 30}",)])
def test_a_theta_that_depends_on_the_horizon_has_no_finer_step(words):
    _, (cell,) = cells_of("scenes=[pushing]", *words)
    with pytest.raises(Unsupported, match="depends on the horizon"):
        stability._refined(cell, 60)


def test_contact_springs_are_oscillators_while_they_last():
    _, (cell,) = cells_of(
        "scenes=[bouncing_ball]",
        "contacts=[penalty]",
        "integrators=[semi_implicit_euler]",
        "scene.bouncing_ball.mass=2",
        "contact.penalty.damping=4",
        "contact.penalty.stiffness=100",
    )
    assert stability.oscillator(cell) == (50.0, 2.0, 1.0)
    # a step is stable up to dt^2 k = 4 - 2 dt c, with k and c per unit of mass
    dt = cell.scene.dt
    assert stability.theory(cell)["stiffness_limit"] == pytest.approx(2.0 * (4.0 / dt - 2.0 * 2.0) / dt)


def test_backends_that_disagree_show_the_worse_verdict_and_no_verdict_is_no_finding():
    words = "study=stability", "scenes=[mass_spring]", "backends=[jax,numpy]", "sweep.stiffness=[10,100]"
    given, rows = unmeasured(*words, "estimators=[fobg]", verdict="ok")
    rows["truth_norm"], rows["relative_error"] = 1.0, 0.01
    rows.loc[(rows["backend"] == "numpy") & (rows["stiffness"] == 100), "relative_error"] = 2.0
    chart = given.study.show(given, rows).charts[0].frame.set_index("stiffness")
    assert dict(chart["level"]) == {10.0: "right", 100.0: "wrong"}
    assert rows["backend"][chart.loc[100.0, "row"]] == "numpy"


def test_an_error_is_measured_against_a_gradient_that_cannot_vanish_and_growth_is_not_an_explosion():
    """Where the true gradient passed through 0, a cell was wrong by an accident of phase."""
    words = "study=stability", "scenes=[mass_spring]", "backends=[jax]", "sweep.stiffness=[10,100,1000,10000]"
    given, rows = unmeasured(*words, "estimators=[fobg]")
    rows["truth_norm"], rows["relative_error"] = [0.2, 7e-5, math.nan, math.nan], [0.0999, 3.0, math.nan, math.nan]
    rows["grad_norm"], rows["reason"] = (
        [0.2, 3e-4, 0.4, 1e9],
        ["", "", *[f"state at step 5 of 9 {stability.GROWN} 10%"] * 2],
    )
    rows["verdict"] = ["ok", "inaccurate", "diverged", "diverged"]
    chart = given.study.show(given, rows).charts[0].frame.set_index("stiffness")
    assert list(chart["level"]) == ["right", "near 0", "grew", "blows up"]
    # a colour is that of the printed number, and a cell that is not right is never drawn as if it were
    assert list(chart["grade"])[:2] == ["error below 100%", "near 0"]
    assert list(chart["cell"])[:2] == ["10", "300"]


@pytest.mark.parametrize(
    ("own", "coarse", "cause"),
    [
        ([1.0, 0.0], [1.0, 0.0], "step"),
        ([2.0, 0.0], [2.0, 0.0], "law"),
        ([1.5, 0.0], [1.5, 0.0], "both"),
        ([1.5, 0.0], [1.6, 0.0], "unknown"),
        ([math.nan, 0.0], [1.6, 0.0], "unknown"),
    ],
)
def test_planted_causes_are_named(monkeypatch, own, coarse, cause):
    """A gradient of twice the truth, and a law whose own gradient is the truth, that gradient, or between."""
    monkeypatch.setattr(stability, "finest", lambda *_: (np.array(own), np.array(coarse)))
    _, (cell,) = cells_of("scenes=[bouncing_ball]", "contacts=[penalty]", "integrators=[rk4]", "backends=[numpy]")
    row = stability.cause_of(cell, "physical", np.array([2.0, 0.0]), np.array([1.0, 0.0]), LIMITS)
    assert row["cause"] == cause


def test_rigid_impacts_are_not_blamed_on_the_law():
    """Impacts without a time of impact follow the physics; how a step at a boundary is differentiated does not."""
    words = ["scene.bouncing_ball.horizon=50", "scene.bouncing_ball.dt=0.02", "backends=[jax]"]
    words += ["scenes=[bouncing_ball]", "contacts=[impulse]", "integrators=[semi_implicit_euler]"]
    (row,) = measured(*words).to_dict("records")
    assert (row["verdict"], row["cause"], row["truth"]) == ("wrong_sign", "step", "physical")
    assert row["law_error"] < 0.05
