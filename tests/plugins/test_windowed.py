"""Gradients through windows: the adjoint behind them, fixed points in closed form, and what may not cross an end."""

import numpy as np
import pytest
from classes import Fobg, Numpy, SemiImplicitEuler, StaticGain, Windowed

import bench
from bench.model import adjoint_gradient, compose, slopes

DIFFERENCED = 1e-6
"""Relative agreement of two gradients by central differences of step 1e-6."""
FIXED = 1e-5
"""Agreement of fixed points with their closed form, as the sheet asks."""
BEST, VALUE = 0.270156, 3.701562
"""K* and P of the infinite horizon."""


def numpy_problem(scene):
    return Numpy().compile(compose(scene, None, SemiImplicitEuler()))


@pytest.mark.parametrize(
    "problem",
    [
        bench.problem("cartpole[horizon=12]", backend="numpy"),
        bench.problem("static_gain[noise=action]", backend="numpy"),
        bench.problem("pushing[horizon=12]", contact="softplus[beta=100]", backend="numpy"),
        bench.problem("friction_block[horizon=12]", backend="numpy"),
    ],
    ids=lambda problem: problem.program.scene.name,
)
def test_adjoint_without_a_cut_is_the_gradient(problem):
    w = np.random.default_rng(0).standard_normal((problem.program.n_noise, 3))
    theta = problem.program.theta0
    found = adjoint_gradient(problem, slopes(problem, theta, w))
    expected = problem.grad(theta, w)
    # rounding of the cost over a step of 1e-6, on both sides
    rounding = 1e-9 * np.abs(problem.value(theta, w)).max()
    assert np.abs(found - expected).max() < 10 * DIFFERENCED * np.abs(expected).max() + rounding


def test_a_window_keeps_the_last_part_of_the_gradient():
    """The derivatives by the controls are proportional to 20, 19, ..., 1, and the last five remain: 55 of 2,870."""
    problem = bench.problem("double_integrator[horizon=20]", backend="numpy")
    still = np.zeros((1, 1, problem.program.n_noise))
    full, window = (e.estimate(problem, problem.program.theta0, still)[0] for e in (Fobg(), Windowed(steps=5)))
    assert window @ full / (full @ full) == pytest.approx(55 / 2870, rel=DIFFERENCED)


@pytest.mark.parametrize("steps", [1, 2, 3, 5])
def test_with_the_exact_value_the_optimal_gain_is_a_fixed_point_at_every_length(steps):
    scene = StaticGain(copies=1, effort=10.0, end=VALUE, gain=-BEST, horizon=10)
    problem, still = numpy_problem(scene), np.zeros((1, 1, 1))
    size = abs(Fobg().estimate(problem, np.array([-0.1]), still)[0, 0])
    found = Windowed(steps=steps, terminal="exact").estimate(problem, problem.program.theta0, still)
    assert abs(found[0, 0]) < FIXED * size
    bare = Windowed(steps=steps, terminal="none").estimate(problem, problem.program.theta0, still)
    assert abs(bare[0, 0]) > 0.01 * size  # without the value it is none


def test_learned_value_takes_most_of_the_bias():
    problem = bench.problem("lqr[horizon=20,sigma=1]", backend="numpy")
    noise = np.random.default_rng(0).standard_normal((16, 64, 20))
    theta = np.full(20, 0.5)
    truth = Fobg().estimate(problem, theta, noise).mean(axis=0)
    error = {
        terminal: np.linalg.norm(
            Windowed(steps=5, terminal=terminal).estimate(problem, theta, noise).mean(axis=0) - truth
        )
        for terminal in ("none", "learned")
    }
    assert error["learned"] < 0.3 * error["none"]


def test_stiff_steps_end_a_window():
    """A cut below every step's stiffness gives windows of one step, one above all gives no cut."""
    problem = bench.problem("pushing[horizon=12]", backend="numpy")
    noise = np.random.default_rng(0).standard_normal((2, 4, 12))
    theta = problem.program.theta0
    low = Windowed(steps=100, cut=1e-9).estimate(problem, theta, noise)
    assert low == pytest.approx(Windowed(steps=1).estimate(problem, theta, noise), rel=1e-9)
    high = Windowed(steps=100, cut=1e9).estimate(problem, theta, noise)
    assert high == pytest.approx(Fobg().estimate(problem, theta, noise), rel=1e-5)
