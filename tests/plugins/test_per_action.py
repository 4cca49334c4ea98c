"""Weights per action and step: by hand in an open loop, and exact ends under a policy."""

import numpy as np
import pytest
from bench.plugins.estimators.total_propagation import TotalPropagation, _weight
from classes import BouncingBall, Cartpole, DoubleIntegrator, Numpy, Pushing, SemiImplicitEuler

from bench.model import compose

DIFFERENCES = 1e-6
"""Relative error of gradients from central differences."""
PER_ACTION = TotalPropagation(per="action")


def compiled(scene):
    return Numpy().compile(compose(scene, None, SemiImplicitEuler()))


def test_open_loop_by_hand():
    """With only an end cost the cost to come is the whole cost, less the mean over the other samples."""
    problem = compiled(DoubleIntegrator(horizon=4, sigma=0.5))
    theta, noise = problem.program.theta0, np.random.default_rng(3).standard_normal((2, 9, 4))
    found, decided = PER_ACTION.estimate_with_diagnostics(problem, theta, noise)
    for r in range(2):
        cost, first = problem.value(theta, noise[r].T), problem.grad(theta, noise[r].T)
        others = [np.delete(cost, n).mean() for n in range(9)]
        zeroth = (cost - others) * noise[r].T / 0.5
        for t in range(4):
            weight = zeroth[t].var(ddof=1) / (zeroth[t].var(ddof=1) + first[t].var(ddof=1))
            assert decided["weight"][r, t] == pytest.approx(weight, rel=DIFFERENCES)
            expected = weight * first[t].mean() + (1 - weight) * zeroth[t].mean()
            assert found[r, t] == pytest.approx(expected, rel=DIFFERENCES)


@pytest.fixture(scope="module")
def policy():
    problem = compiled(Cartpole(horizon=6, sigma=0.5))
    return problem, problem.program.theta0, np.random.default_rng(4).standard_normal((40, 400, problem.program.n_noise))


def test_zeroth_order_per_action_has_the_policys_gradient_as_its_mean(policy, monkeypatch):
    """With all weights on the zeroth order the mean is still that of the first order: the chain is right."""
    problem, theta, noise = policy
    first = problem.grad(theta, noise.reshape(-1, noise.shape[2]).T)
    mean, error = first.mean(axis=1), first.std(axis=1) / np.sqrt(first.shape[1])
    for weight in (np.zeros_like, np.ones_like):
        monkeypatch.setattr(f"{_weight.__module__}._weight", lambda v0, v1, weight=weight: weight(v0))
        found = PER_ACTION.estimate(problem, theta, noise)
        spread = found.std(axis=0, ddof=1) / np.sqrt(len(found))
        # 4.5 standard errors: below 1e-5 by chance
        assert (np.abs(found.mean(axis=0) - mean) < 4.5 * np.hypot(spread, error)).all()


def test_actions_without_noise_of_their_own_are_refused():
    assert "noise on the action" in PER_ACTION.unsupported_reason(compose(Pushing(hold=3), None, SemiImplicitEuler()))
    assert "noise on the action" in PER_ACTION.unsupported_reason(compose(BouncingBall(), None, SemiImplicitEuler()))
    assert PER_ACTION.unsupported_reason(compose(Pushing(), None, SemiImplicitEuler())) is None
