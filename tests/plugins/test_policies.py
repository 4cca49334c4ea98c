"""Policies, and the scenes and programs that use them."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from bench.plugins.scenes.cartpole_swing import CartpoleSwing

from bench.errors import UserError
from bench.experiment.by_name import compile_problem, make
from bench.measure import noise
from bench.model import LoopOps, State, adjoint_gradient, slopes
from bench.model.policy import policy_of, uniform

DIFFERENCED = 1e-6
"""Relative error of central differences of the cost, whose steps are 1e-6."""


def problem(policy="mlp[hidden=8]", backend="jax", **parameters):
    scene = make("scenes", f"cartpole_swing[policy={policy},horizon=30]")
    return compile_problem(dataclasses.replace(scene, **parameters), None, "semi_implicit_euler", backend)


def sample(problem, count=6):
    return noise.draw(0, "policy", 1, count, problem.program.n_noise, "test")[0].T


@pytest.mark.parametrize("activation", ["elu", "relu"])
def test_activations_far_from_zero_have_finite_values(activation):
    values = policy_of(f"mlp[hidden=4,activation={activation}]").act(
        np, np.full((4 * 3 + 5, 1), 500.0), np.ones((2, 3))
    )
    assert np.isfinite(values).all()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("mpl", "policy.*'mpl'.*'mlp'"),
        ("mlp[hidden=8x]", "widths such as 64x64"),
        ("mlp[width=8]", "parameter of policy mlp.*'width'"),
        ("mlp[activation=tan]", "mlp.activation.*'tan'.*'tanh'"),
    ],
)
def test_an_invalid_policy_is_named(policy, message):
    with pytest.raises(UserError, match=message):
        make("scenes", f"cartpole_swing[policy={policy}]")


def test_lists_and_numbers_are_widths():
    assert policy_of("mlp[hidden=[8,4]]") == policy_of("mlp[hidden=8x4]")
    assert policy_of("mlp[hidden=8]").widths == [8]


def test_two_normal_numbers_give_a_uniform_one():
    drawn = uniform(np, np.random.default_rng(0).standard_normal((2, 200_000)))[0]
    counts = np.histogram(drawn, 20, (0, 1))[0]
    assert counts.sum() == drawn.size
    assert ((counts - 1e4) ** 2 / 1e4).sum() < 43.8  # 99.9% quantile of chi-square with 19 degrees of freedom


def test_the_adjoint_without_jax_takes_differences(monkeypatch):
    exact = problem()
    theta, w = exact.program.theta0, sample(exact)
    by_product = adjoint_gradient(exact, slopes(exact, theta, w))
    monkeypatch.setattr(CartpoleSwing, "pullback", lambda *_, **__: None)
    by_differences = adjoint_gradient(exact, slopes(exact, theta, w))
    assert np.abs(by_differences - by_product).max() < DIFFERENCED * np.abs(by_product).max()


def test_the_adjoint_keeps_no_copy_of_theta_for_each_step():
    long = problem("mlp[hidden=64x64]")
    theta, w = long.program.theta0, sample(long)
    slopes(long, theta, w)
    tracemalloc.start()
    slopes(long, theta, w)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * theta.size * w.shape[1] * 30 / 2  # a copy for each of the 30 steps would be twice that


def test_substeps_are_steps_of_the_integrator():
    coarse, fine = problem(substeps=1, horizon=8), problem(substeps=4, horizon=2)
    start, u = State(np.array([[0.1], [2.0]]), np.array([[0.3], [-0.2]])), np.array([[0.7]])
    a, b = start, start
    for _ in range(4):
        a = coarse.program.step(LoopOps(), a, u)
    fine.program.scene = dataclasses.replace(fine.program.scene, dt=4 * coarse.program.scene.dt)
    b = fine.program.step(LoopOps(), b, u)
    assert np.concatenate(a) == pytest.approx(np.concatenate(b), rel=1e-13)


class Ending(CartpoleSwing):
    """A cart-pole whose rollouts end where the cart passes 1 m."""

    def has_ended(self, xp, q, v):
        return xp.abs(q[0]) > 1.0


def test_a_rollout_that_has_ended_stays():
    scene = Ending(policy="linear", horizon=60)
    given = compile_problem(scene, None, "semi_implicit_euler", "numpy")
    theta = given.program.theta0 + np.array([0, 0, 0, 0, 0, 3.0])  # a bias that pushes the cart away
    w = sample(given, 16)
    path = given.program.steps(LoopOps(), theta[:, None], w)
    states = np.stack([state.q[0] for state, _ in path])
    ended = np.abs(states) > 1.0
    assert ended[-1].any()
    first = np.argmax(ended, axis=0)
    for column in np.flatnonzero(ended[-1]):
        assert (states[first[column] :, column] == states[first[column], column]).all()
