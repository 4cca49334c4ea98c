"""Weights per action and step: by hand in an open loop, and exact ends under a policy."""

import numpy as np
import pytest
from bench.plugins.estimators.total_propagation import TotalPropagation, _weight
from classes import BouncingBall, Cartpole, Numpy, Pushing, SemiImplicitEuler

from bench.model import compose

PER_ACTION = TotalPropagation(per="action")


def compiled(scene):
    return Numpy().compile(compose(scene, None, SemiImplicitEuler()))


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
    assert "noise on the action" in PER_ACTION.own_refusal(compose(Pushing(hold=3), None, SemiImplicitEuler()))
    assert "noise on the action" in PER_ACTION.own_refusal(compose(BouncingBall(), None, SemiImplicitEuler()))
    assert PER_ACTION.own_refusal(compose(Pushing(), None, SemiImplicitEuler())) is None
