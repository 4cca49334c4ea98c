"""Estimators that weight two means, against the same weights written by hand."""

import numpy as np
import pytest
from bench.plugins.estimators.total_propagation import TotalPropagation, _weight
from classes import (
    AlphaOrder,
    Cartpole,
    Clipped,
    Cubic,
    InverseVariance,
    Numpy,
    Penalty,
    SemiImplicitEuler,
    SphereSmoothing,
    TwoBalls,
)

from bench.model import compose

EXACT = 1e-12
"""The same few operations in another order."""
REPEATS, SAMPLES = 3, 11


@pytest.fixture(scope="module")
def halves():
    """Problem, noise, and by repeat the gradients of the first 5 samples and the zeroth-order terms of the other 6."""
    problem = Numpy().compile(compose(Cubic(dimension=2, sigma=0.4)))
    theta = problem.program.theta0
    noise = np.random.default_rng(0).standard_normal((REPEATS, SAMPLES, 2))
    centre = problem.value(theta, np.zeros((2, 1)))
    first = [problem.grad(theta, w[:5].T) for w in noise]
    zeroth = [(problem.value(theta, w[5:].T) - centre) * w[5:].T / 0.4 for w in noise]
    return problem, theta, noise, first, zeroth


def less_the_mean_of_the_others(costs):
    return np.array([cost - np.delete(costs, i).mean() for i, cost in enumerate(costs)])


def test_inverse_variance_by_hand(halves):
    problem, theta, noise, first, _ = halves
    found = InverseVariance().estimate(problem, theta, noise)
    zeroth = [less_the_mean_of_the_others(problem.value(theta, w[5:].T)) * w[5:].T / 0.4 for w in noise]
    for r in range(REPEATS):
        for i in range(2):
            one, other = first[r][i], zeroth[r][i]
            a, b = np.var(one, ddof=1) / 5, np.var(other, ddof=1) / 6
            assert found[r, i] == pytest.approx((one.mean() / a + other.mean() / b) / (1 / a + 1 / b), rel=EXACT)


def test_alpha_order_by_hand(halves):
    """With a generous gamma the weight is that of the variances of both means, over all coordinates."""
    problem, theta, noise, first, zeroth = halves
    found = AlphaOrder(gamma=1e9, sharing="split").estimate(problem, theta, noise)
    for r in range(REPEATS):
        v1 = sum(np.var(first[r][i], ddof=1) / 5 for i in range(2))
        v0 = sum(np.var(zeroth[r][i], ddof=1) / 6 for i in range(2))
        alpha = v0 / (v1 + v0)
        assert found[r] == pytest.approx(
            alpha * first[r].mean(axis=1) + (1 - alpha) * zeroth[r].mean(axis=1), rel=EXACT
        )


@pytest.mark.parametrize(
    ("method", "alpha", "doubtful"),
    [(AlphaOrder(), 0.99, True), (AlphaOrder(), 0.8, False), (AlphaOrder(ratio=3.0), 0.99, False),
     (AlphaOrder(gamma=1.2), 0.99, True), (AlphaOrder(gamma=0.01), 0.0, False)],
)  # fmt: skip
def test_rare_caps_of_alpha_order_are_a_remark(method, alpha, doubtful):
    assert bool(method.remark({"alpha": {"median": alpha}, "eps": {"median": 1.0}})) == doubtful


@pytest.mark.parametrize("by", ["sample", "element"])
def test_clipped_by_hand(halves, by):
    """Of 11 gradients of two coordinates, each is cut to the batch's quantile: its norm, or each coordinate alone."""
    problem, theta, noise, *_ = halves
    found = Clipped(by=by, quantile=0.5).estimate(problem, theta, noise)
    for r in range(REPEATS):
        terms = problem.grad(theta, noise[r].T)
        sizes = np.abs(terms) if by == "element" else np.sqrt(terms[0] ** 2 + terms[1] ** 2)[None]
        limit = np.median(sizes, axis=1)
        cut = [
            [t * min(1.0, limit[i % len(sizes)] / s) for t, s in zip(terms[i], sizes[i % len(sizes)], strict=True)]
            for i in range(2)
        ]
        assert found[r] == pytest.approx(np.mean(cut, axis=1), rel=EXACT)


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
