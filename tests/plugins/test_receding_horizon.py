"""The example of plans that are made again at each step: its runs, its plans, and faults of both."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from bench.plugins.optimizers.cem import Cem
from bench.plugins.optimizers.mppi import Mppi
from scipy.stats import t as student

import bench
from bench.measure.solve import solve
from bench.model import slopes

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = runpy.run_path(str(ROOT / "examples" / "control" / "receding_horizon.py"))
STEPS = EXAMPLE["STEPS"]
THETA, COST, STATES, GAINS = EXAMPLE["PLAN"]
SAME = 1e-9
"""Relative difference between two ways to run the same program."""
SEEDS = range(6)


def lower_end(values):
    """The lower end of the 95% interval of a mean."""
    return values.mean() - student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5


def run_costs(law, sigma=1.0):
    """Costs of one law per seed."""
    noises = [np.random.default_rng(seed).standard_normal(STEPS) for seed in SEEDS]
    return np.array([EXAMPLE["run_cost"](law(s), sigma, w) for s, w in zip(SEEDS, noises, strict=True)])


def test_a_run_of_fixed_controls_is_a_rollout_of_the_program():
    problem = bench.problem("pendulum_swing[dt=0.1,horizon=60,sigma=0.7]", backend="numpy")
    w = np.random.default_rng(3).standard_normal(STEPS)
    ours = EXAMPLE["run_cost"](lambda t, x: THETA[t], 0.7, w)
    assert ours == pytest.approx(problem.value(THETA, w[:, None])[0], rel=SAME)


@pytest.mark.slow
def test_the_plan_made_once_is_the_optimum():
    least = solve(bench.problem("pendulum_swing[dt=0.1,horizon=60]", backend="numpy"))
    assert least.certified
    assert pytest.approx(least.cost, rel=SAME) == COST


def test_the_regulator_minimises_the_cost_of_the_linearised_steps():
    """Its changes and gains, step by step, and one linear system for all controls together."""
    problem, rng = EXAMPLE["swing"](8, 2.0, 0.5), np.random.default_rng(0)
    theta, scene = rng.standard_normal(8), problem.program.scene
    path = slopes(problem, theta, np.zeros((8, 1)))
    changes, gains, descent, curvature = EXAMPLE["regulator"](scene, path)

    x, found, along = np.zeros(2), [], [np.zeros((2, 8))]
    for a, b, change, gain in zip(path.a[..., 0], path.b[..., 0], changes, gains, strict=True):
        found.append(change + gain @ x)
        x = a @ x + b[:, 0] * found[-1]
        along.append(a @ along[-1] + b * np.eye(8)[len(along) - 1])
    weights = np.append(np.full(8, 2.0), 2.0 * scene.terminal)
    slope = path.cost_u[:, 0, 0] + sum(m.T @ c for m, c in zip(along, path.cost_x[..., 0], strict=True))
    hessian = 2.0 * scene.effort * np.eye(8) + sum(w * m.T @ m for m, w in zip(along, weights, strict=True))
    expected = -np.linalg.solve(hessian, slope)
    assert found == pytest.approx(expected, rel=SAME)
    assert (descent, curvature) == pytest.approx((-slope @ expected, expected @ hessian @ expected), rel=SAME)


@pytest.mark.parametrize(
    ("planner", "error"),
    [(EXAMPLE["ilqr"], 1e-3), (EXAMPLE["sampled"](Mppi(population=4000, width=0.7, temperature=0.1)), 0.3)],
)
def test_the_first_control_is_that_of_the_best_plan_from_the_present_state(planner, error):
    steps, (angle, rate) = EXAMPLE["AHEAD"], (2.0, 0.5)
    least = solve(EXAMPLE["swing"](steps, angle, rate))
    assert least.certified
    first = EXAMPLE["receding"](planner, 0)(STEPS - steps, np.array([angle, rate]))
    assert first == pytest.approx(least.theta[0], abs=error)
    assert abs(first) > 3 * error


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", [Mppi(population=64, width=1.0, temperature=0.1), Cem(population=64, elites=8)])
def test_plans_from_the_present_state_cost_less_than_one_plan_and_than_plans_from_another_state(optimizer):
    planner = EXAMPLE["sampled"](optimizer)
    again = run_costs(lambda seed: EXAMPLE["receding"](planner, seed))
    once = run_costs(lambda seed: lambda t, x: THETA[t])
    assert lower_end(once - again) > 0.0

    def blind(seed):
        law = EXAMPLE["receding"](planner, seed)
        return lambda t, x: law(t, STATES[t])

    assert lower_end(run_costs(blind) - again) > 0.0


@pytest.mark.slow
def test_the_page_has_the_table_of_the_example():
    assert EXAMPLE["table"]() in (ROOT / "docs" / "controller.md").read_text()
