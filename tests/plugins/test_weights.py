"""Estimators that weight two means, against the same weights written by hand."""

import numpy as np
import pytest
from bench.plugins.estimators.total_propagation import TotalPropagation, _weight
from classes import (
    AlphaOrder,
    Cartpole,
    Cubic,
    InverseVariance,
    Numpy,
    Penalty,
    SemiImplicitEuler,
    SphereSmoothing,
    TwoBalls,
)

from bench.model import compose
from bench.model.design import sums_of_units
from bench.model.estimator import less_others

EXACT = 1e-12
"""The same few operations in another order."""


def less_the_mean_of_the_others(costs):
    return np.array([cost - np.delete(costs, i).mean() for i, cost in enumerate(costs)])


def test_two_halves_are_weighted_by_hand():
    """5 gradients and 6 zeroth-order terms: by each coordinate's variance, or, with a generous gamma, by their sum."""
    problem = Numpy().compile(compose(Cubic(dimension=2, sigma=0.4)))
    theta, noise = problem.program.theta0, np.random.default_rng(0).standard_normal((3, 11, 2))
    centre = problem.value(theta, np.zeros((2, 1)))
    methods = InverseVariance(), AlphaOrder(gamma=1e9, sharing="split")
    each, whole = (method.estimate(problem, theta, noise) for method in methods)
    for r, w in enumerate(noise):
        first, costs, scores = problem.grad(theta, w[:5].T), problem.value(theta, w[5:].T), w[5:].T / 0.4
        by_others, by_centre = less_the_mean_of_the_others(costs) * scores, (costs - centre) * scores
        for found, zeroth, total in ((each[r], by_others, np.array), (whole[r], by_centre, np.sum)):
            v1, v0 = (total(np.var(terms, axis=1, ddof=1) / terms.shape[1]) for terms in (first, zeroth))
            expected = (v0 * first.mean(axis=1) + v1 * zeroth.mean(axis=1)) / (v0 + v1)
            assert found == pytest.approx(expected, rel=EXACT)


@pytest.mark.parametrize(
    ("method", "alpha", "doubtful"),
    [
        (AlphaOrder(), 0.99, True),
        (AlphaOrder(), 0.8, False),
        (AlphaOrder(ratio=3.0), 0.99, False),
        (AlphaOrder(gamma=1.2), 0.99, True),
        (AlphaOrder(gamma=0.01), 0.0, False),
    ],
)
def test_rare_caps_of_alpha_order_are_a_remark(method, alpha, doubtful):
    assert bool(method.remark({"alpha": {"median": alpha}, "eps": {"median": 1.0}})) == doubtful


def test_the_default_sphere_smoothes_a_cubic_as_the_normal_does():
    """Ball and normal have the same covariance then, so that the gradient is theta^2 + sigma^2 too."""
    problem = Numpy().compile(compose(Cubic(dimension=2, sigma=0.4)))
    angles = 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    noise = np.stack([np.cos(angles), np.sin(angles)], axis=1)[None]
    found = SphereSmoothing().estimate(problem, problem.program.theta0, noise)[0]
    assert found == pytest.approx(problem.program.theta0**2 + 0.4**2, rel=1e-10)


@pytest.mark.parametrize("per", ["step", "control"])
def test_total_propagation_by_hand(per):
    """The two controls of a step are weighted together, or each by itself."""
    problem = Numpy().compile(compose(TwoBalls(horizon=3, dt=0.1, sigma=2.0), Penalty(), SemiImplicitEuler()))
    theta = problem.program.theta0
    noise = np.random.default_rng(1).standard_normal((2, 7, theta.size))
    found, said = TotalPropagation(per=per).estimate_with_diagnostics(problem, theta, noise)
    for r in range(2):
        w = noise[r].T
        first, zeroth = problem.grad(theta, w), less_the_mean_of_the_others(problem.value(theta, w)) * w / problem.sigma
        for i in range(theta.size):
            mine = [i] if per == "control" else [i - i % 2, i - i % 2 + 1]
            v1, v0 = (sum(np.var(terms[j], ddof=1) for j in mine) for terms in (first, zeroth))
            weight = v0 / (v0 + v1)
            assert said["weight"][r, i] == pytest.approx(weight, rel=1e-9)
            assert found[r, i] == pytest.approx(weight * first[i].mean() + (1 - weight) * zeroth[i].mean(), rel=1e-9)


# ------------------------------------------------------------------------------------------------ weights per action


@pytest.fixture(scope="module")
def policy():
    problem = Numpy().compile(compose(Cartpole(horizon=6, sigma=0.5), None, SemiImplicitEuler()))
    return problem, problem.program.theta0, np.random.default_rng(4).standard_normal((40, 400, problem.program.n_noise))


def test_zeroth_order_per_action_has_the_policys_gradient_as_its_mean(policy, monkeypatch):
    """With all weights on the zeroth order the mean is still that of the first order: the chain is right."""
    problem, theta, noise = policy
    first = problem.grad(theta, noise.reshape(-1, noise.shape[2]).T)
    mean, error = first.mean(axis=1), first.std(axis=1) / np.sqrt(first.shape[1])
    for weight in (np.zeros_like, np.ones_like):
        monkeypatch.setattr(f"{_weight.__module__}._weight", lambda v0, v1, weight=weight: weight(v0))
        found = TotalPropagation(per="action").estimate(problem, theta, noise)
        spread = found.std(axis=0, ddof=1) / np.sqrt(len(found))
        # 4.5 standard errors: below 1e-5 by chance
        assert (np.abs(found.mean(axis=0) - mean) < 4.5 * np.hypot(spread, error)).all()


@pytest.mark.parametrize("unit", [1, 2, 3])
def test_costs_are_less_the_mean_of_the_samples_in_other_units(unit):
    costs = np.random.default_rng(1).standard_normal((2, 6))
    own = sums_of_units(costs, unit)
    assert less_others(costs, unit) == pytest.approx(costs - (costs.sum(axis=1, keepdims=True) - own) / (6 - unit))
