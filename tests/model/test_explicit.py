"""Scores where theta also sets the initial state: the term that cost times score lacks."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from bench.plugins.backends.jax import Jax
from bench.plugins.backends.mujoco import Mujoco
from bench.plugins.backends.numpy import Numpy
from bench.plugins.backends.torch import Torch
from bench.plugins.estimators.alpha_order import AlphaOrder
from bench.plugins.estimators.inverse_variance import InverseVariance
from bench.plugins.estimators.optimal_baseline import OptimalBaseline
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.cartpole import Cartpole
from bench.plugins.scenes.pushing import Pushing

from bench.conformance.scenes import score_gives_the_gradient
from bench.measure import noise
from bench.measure.reference import certify
from bench.measure.statistics import Truth, summarise
from bench.model import MechanicalScene, State, compose, param

EXACT = 1e-12
"""Relative difference of the same derivatives from two libraries."""
DIFFERENCED = 1e-6
"""Relative error of the numpy backend's central differences."""


@dataclass(frozen=True)
class Gusts(MechanicalScene):
    """A mass slides from theta = v_0 and is pushed by gusts: f = (q_T - 1)^2, so that grad J = 2 T (T v_0 - 1)."""

    name = "gusts"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1
    noise: str = param("action", "what the noise perturbs", choices=("action",))
    sigma: float = param(0.3, "of each gust", positive=True)
    horizon: int = param(20, "steps", positive=True)
    dt: float = param(0.05, "step", "s", positive=True)

    def theta0(self):
        return np.array([1.7])

    def initial_state(self, xp, theta):
        return State(0.0 * theta[0:1], theta[0:1])

    def acceleration(self, xp, q, v, u):
        return u

    def terminal_cost(self, xp, q, v):
        return (q[0] - 1.0) ** 2

    def truth(self):
        duration = self.horizon * self.dt
        return np.array([2.0 * duration * (duration * 1.7 - 1.0)])


@dataclass(frozen=True)
class Guided(Gusts):
    """The same with a gain: theta = (q_0, K) and u = -K q^3 + gust, so that the start moves what the policy sees."""

    name = "guided"

    def theta0(self):
        return np.array([0.8, 1.3])

    def initial_state(self, xp, theta):
        return State(theta[0:1], 0.0 * theta[0:1])

    def feedback(self, xp, theta, q, v):
        return -theta[1:2] * q**3 - v


@dataclass(frozen=True)
class StartAndPush(Gusts):
    """Open loop, and the first push sets the start as well: the noise is not noise on theta."""

    name = "start_and_push"
    open_loop: ClassVar[bool] = True

    def theta0(self):
        return np.linspace(0.5, 1.0, self.horizon)

    def initial_state(self, xp, theta):
        return State(theta[0:1], 0.0 * theta[0:1])


SCENES = [Gusts(), Guided(), StartAndPush()]


def composed(scene):
    return compose(scene, None, SemiImplicitEuler())


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_program_knows_that_theta_sets_the_start(scene):
    program = composed(scene)
    assert program.explicit
    assert not program.noise_on_theta
    bound = program.bind(program.parameters())
    assert bound.explicit


def test_shipped_scenes_have_no_explicit_dependence():
    assert not composed(Cartpole()).explicit
    pushing = composed(Pushing())
    assert not pushing.explicit
    assert pushing.noise_on_theta


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_score_and_explicit_derivative_make_the_gradient(scene):
    """Against the cost's own differences at fixed noise, whose mean is the gradient too."""
    assert "with explicit" in score_gives_the_gradient(scene)


def test_kit_finds_the_missing_term(monkeypatch):
    monkeypatch.setattr("bench.model.problem.Problem.explicit", lambda self, theta, w: np.zeros((self.dim, w.shape[1])))
    with pytest.raises(Exception, match="standard errors from the mean gradient"):
        score_gives_the_gradient(Gusts())


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_backends_agree_on_score_and_explicit_derivative(scene):
    program = composed(scene)
    w = np.random.default_rng(1).standard_normal((program.n_noise, 5))
    theta = program.theta0[:, None] * np.linspace(0.9, 1.1, 5)
    plain, torch, jax = (backend.compile(program) for backend in (Numpy(), Torch(), Jax()))
    for name in ("score", "explicit"):
        exact = getattr(torch, name)(theta, w)
        scale = np.abs(exact).max() or 1.0
        assert getattr(jax, name)(theta, w) == pytest.approx(exact, abs=EXACT * scale)
        assert getattr(plain, name)(theta, w) == pytest.approx(exact, abs=DIFFERENCED * scale)


@pytest.mark.parametrize(
    "estimator", [Reinforce(), Reinforce(baseline="none"), Reinforce(baseline="leave_one_out"), OptimalBaseline()]
)
def test_reinforce_is_unbiased_where_theta_is_the_start(estimator):
    problem = Torch().compile(composed(Gusts()))
    w = noise.draw(3, "gusts", 64, 32, problem.program.n_noise, "explicit")
    values = estimator.estimate(problem, problem.program.theta0, w)
    error = values.std(ddof=1) / 8
    assert abs(values.mean() - Gusts().truth()[0]) < 4 * error < 0.01


@pytest.mark.parametrize("estimator", [AlphaOrder(), InverseVariance()], ids=["alpha_order", "inverse_variance"])
def test_weighted_estimators_add_the_term_too(estimator):
    problem = Torch().compile(composed(Gusts()))
    w = noise.draw(3, "gusts", 64, 64, problem.program.n_noise, "explicit")
    summary = summarise(estimator.estimate(problem, problem.program.theta0, w), Truth.exact(Gusts().truth()), 64)
    assert summary.bias_rel < 0.05  # 1.4 of 1.4 without the term


@pytest.mark.parametrize("provides", [Torch.provides, frozenset({"value", "score", "explicit"})])
def test_reference_is_the_gradient(provides):
    truth = certify(Torch().compile(composed(Gusts())), provides, 1 << 14, 0.005)
    error = truth.known().standard_error
    assert abs(truth.gradient[0] - Gusts().truth()[0]) < 4 * error + 1e-9
    assert error < 0.1


def test_what_does_not_add_the_term_is_refused():
    program = composed(Gusts())

    class Careless(Reinforce):
        includes_explicit_derivative = False

    assert "lacks a term" in Careless().incompatibility(program, Torch.provides, "torch")
    assert "needs explicit, which mujoco lacks" in Reinforce().incompatibility(program, Mujoco.provides, "mujoco")
    assert Reinforce().incompatibility(program, Torch.provides, "torch") is None
    assert Careless().incompatibility(composed(Cartpole()), Torch.provides, "torch") is None
