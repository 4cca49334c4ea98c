"""The example of plans that are made again at each step: its runs, its plans, and faults of both."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from bench.plugins.optimizers.mppi import Mppi
from bench.plugins.studies.optimise.solve import solve

import bench

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = runpy.run_path(str(ROOT / "examples" / "control" / "receding_horizon.py"))
STEPS = EXAMPLE["STEPS"]
THETA, COST, STATES, GAINS = EXAMPLE["PLAN"]
SAME = 1e-9
"""Relative difference between two ways to run the same program."""


def test_a_run_of_fixed_controls_is_a_rollout_of_the_program():
    problem = bench.problem("pendulum_swing[dt=0.1,horizon=60,sigma=0.7]", backend="numpy")
    w = np.random.default_rng(3).standard_normal(STEPS)
    ours = EXAMPLE["run_cost"](lambda t, x: THETA[t], 0.7, w)
    assert ours == pytest.approx(problem.value(THETA, w[:, None])[0], rel=SAME)


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


@pytest.mark.full
def test_the_page_has_the_table_of_the_example():
    assert EXAMPLE["table"]() in (ROOT / "docs" / "controller.md").read_text()
