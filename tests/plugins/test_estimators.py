"""Estimators against closed-form biases and variances, and where two of them really differ."""

import math
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from bench.plugins.backends.jax import Jax
from bench.plugins.backends.numpy import Numpy
from bench.plugins.backends.torch import Torch
from bench.plugins.contacts.penalty import Penalty
from bench.plugins.estimators.alpha_order import AlphaOrder
from bench.plugins.estimators.clipped import Clipped
from bench.plugins.estimators.control_variate import ControlVariate
from bench.plugins.estimators.finite_difference import FiniteDifference
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.guided import Guided
from bench.plugins.estimators.inverse_variance import InverseVariance
from bench.plugins.estimators.measure_valued import MeasureValued
from bench.plugins.estimators.orthogonal import Orthogonal
from bench.plugins.estimators.randomized_smoothing import RandomizedSmoothing
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.estimators.sphere_smoothing import SphereSmoothing
from bench.plugins.estimators.total_propagation import TotalPropagation
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.cartpole import Cartpole
from bench.plugins.scenes.heaviside import Heaviside
from bench.plugins.scenes.linear import Linear
from bench.plugins.scenes.pushing import Pushing
from bench.plugins.scenes.soft_heaviside import SoftHeaviside
from scipy import stats

from bench.measure import noise
from bench.measure.reference import certify
from bench.measure.statistics import summarise
from bench.model import FunctionScene, compose

SIGMA, SAMPLES, REPEATS = 0.1, 200, 400


# Exact derivatives throughout: the differences of the numpy backend see a jump when a sample falls within a step of it.


def measured(scene, estimator, backend=None, integrator=None, samples=SAMPLES, repeats=REPEATS):
    backend = backend or Torch()
    problem = backend.compile(compose(scene, None, integrator))
    truth = certify(problem, backend.provides, 1 << 17, 0.005)
    w = noise.draw(0, scene.name, repeats, samples, problem.program.n_noise, "cells")
    return summarise(estimator.estimate(problem, problem.program.theta0, w), truth.known(), samples)


@cache
def midpoints():
    """Nodes between -9 and 9 and their weights under the standard normal density."""
    w = np.linspace(-9, 9, 2_000_001)
    w = (w[1:] + w[:-1]) / 2
    return w, stats.norm.pdf(w) * (w[1] - w[0])


def moments(terms):
    """Mean and variance of ``terms(w)``, w standard normal, by a fine midpoint rule."""
    w, weight = midpoints()
    values = terms(w)
    mean = float(values @ weight)
    return mean, float((values - mean) ** 2 @ weight)


def step(x):
    return (x >= 0).astype(float)


def ramp(nu):
    return lambda x: np.clip(2 * x / nu, -1, 1)


def expected(f, slope, theta, h=0.02):
    """Per-sample mean and variance of every estimator that is a mean, by name."""
    s = SIGMA
    return {
        Fobg(): moments(lambda w: slope(theta + s * w)),
        Reinforce(baseline="none"): moments(lambda w: f(theta + s * w) * w / s),
        Reinforce(): moments(lambda w: (f(theta + s * w) - f(np.array(theta))) * w / s),
        RandomizedSmoothing(): moments(lambda w: (f(theta + s * w) - f(theta - s * w)) * w / (2 * s)),
        RandomizedSmoothing(variant="forward"): moments(lambda w: (f(theta + s * w) - f(np.array(theta))) * w / s),
        FiniteDifference(step=h): moments(lambda w: (f(theta + s * w + h) - f(theta + s * w - h)) / (2 * h)),
    }


CASES = [
    pytest.param(scene, estimator, mean, variance, id=f"{scene.name} {estimator}")
    for scene, table in (
        (Heaviside(sigma=SIGMA), expected(step, np.zeros_like, 0.0)),
        (Heaviside(sigma=SIGMA, theta=0.1), expected(step, np.zeros_like, 0.1)),
        (SoftHeaviside(sigma=SIGMA, nu=0.1), expected(ramp(0.1), lambda x: (abs(x) < 0.05) * 20.0, 0.0)),
        (SoftHeaviside(sigma=SIGMA, nu=0.01), expected(ramp(0.01), lambda x: (abs(x) < 0.005) * 200.0, 0.0)),
    )
    for estimator, (mean, variance) in table.items()
]


@pytest.mark.parametrize(("scene", "estimator", "mean", "variance"), CASES)
def test_bias_and_variance_are_the_closed_form_ones(scene, estimator, mean, variance):
    summary = measured(scene, estimator)
    truth = scene.closed_form_gradient(None, None)[0]
    bias = abs(mean - truth)
    slack = 1e-4 * abs(truth)  # of the quadrature above, whose nodes straddle the jumps
    assert summary.bias_low - slack <= bias <= summary.bias_high + slack
    ratio = summary.variance_per_sample / variance if variance > 1e-9 else 1.0
    inside = summary.variance_low <= variance / SAMPLES <= summary.variance_high
    assert inside or abs(ratio - 1) < 0.03
    if variance < 1e-9:
        assert summary.variance == 0.0


def test_leave_one_out_has_no_bias_and_less_variance_than_no_baseline():
    alone, plain = (measured(Heaviside(theta=0.1), Reinforce(baseline=b)) for b in ("leave_one_out", "none"))
    assert alone.indistinguishable
    assert alone.variance_high < plain.variance_low


@pytest.mark.parametrize("estimator", [InverseVariance(), AlphaOrder(gamma=1e6)], ids=str)
def test_mixtures_that_trust_low_variance_are_wholly_wrong_at_a_jump(estimator):
    summary = measured(Heaviside(), estimator)
    assert summary.bias == pytest.approx(3.98942, rel=1e-5)
    assert summary.variance == 0.0


def test_alpha_order_keeps_within_its_accuracy_where_the_mixture_fails():
    summary = measured(Heaviside(), AlphaOrder(gamma=3.0), samples=800)
    assert summary.bias_high < 3.0
    assert measured(
        Heaviside(), AlphaOrder(gamma=0.1)
    ).indistinguishable  # its test cannot be met, which leaves zeroth order


def test_mixtures_gain_where_both_orders_are_right():
    scene = SoftHeaviside(nu=0.2)
    mixed = measured(scene, InverseVariance())
    for half in (Fobg(), Reinforce()):
        assert mixed.variance < measured(scene, half, samples=SAMPLES // 2).variance
    assert mixed.bias_rel < 0.02


def test_confidence_radius_uses_the_failure_probability():
    """eps = sqrt(2 V ln((d+1)/delta)/N) + 2 L ln((d+1)/delta)/(3 N): at its edge the weight drops to 0."""
    scene, n = SoftHeaviside(nu=0.2), 400
    problem = Torch().compile(compose(scene))
    w = noise.draw(3, scene.name, 1, n, 1, "cells")
    zeroth = Reinforce().estimate(problem, scene.theta0(), w[:, n // 2 :])
    terms = np.array([Reinforce().estimate(problem, scene.theta0(), w[:, i : i + 1])[0, 0] for i in range(n // 2, n)])
    log_term = math.log(2 / 0.05)
    eps = math.sqrt(2 * terms.var(ddof=1) * log_term / (n // 2)) + 2 * abs(terms).max() / (3 * (n // 2)) * log_term
    below, above = (AlphaOrder(gamma=eps * factor).estimate(problem, scene.theta0(), w) for factor in (0.999, 1.001))
    assert below == pytest.approx(zeroth, rel=1e-12)
    assert above[0, 0] != below[0, 0]
    assert abs(above - below).max() <= 0.0011 * eps


def weights(estimator, stiffness, samples=100, repeats=12):
    program = compose(Pushing(horizon=10, sigma=0.1), Penalty(stiffness=stiffness), SemiImplicitEuler())
    problem = Numpy().compile(program)
    w = noise.draw(0, "pushing", repeats, samples, program.n_noise, "cells")
    truth = certify(problem, Numpy().provides, 1 << 14, 0.005)
    values, decided = estimator.estimate_with_diagnostics(problem, program.theta0, w)
    return summarise(values, truth.known(), samples).rmse_rel, decided.get("alpha")


@pytest.mark.parametrize("stiffness", [10.0, 1e3])
def test_the_default_accuracy_leaves_alpha_order_its_first_order_share(stiffness):
    error, alpha = weights(AlphaOrder(), stiffness)
    assert (alpha > 0).all()
    assert error < 0.5 * weights(Reinforce(), stiffness)[0]


def test_a_fixed_accuracy_far_below_eps_is_the_zeroth_order_alone():
    assert (weights(AlphaOrder(gamma=0.01), 1e3)[1] == 0).all()


def test_sharing_takes_every_sample_for_both_orders():
    problem = Torch().compile(compose(SoftHeaviside(nu=0.2)))
    theta, w = problem.program.theta0, noise.draw(5, "shared", 3, 64, 1, "cells")
    shared, decided = AlphaOrder(sharing="shared").estimate_with_diagnostics(problem, theta, w)
    alpha = decided["alpha"][:, None]
    expected = alpha * Fobg().estimate(problem, theta, w) + (1 - alpha) * Reinforce().estimate(problem, theta, w)
    np.testing.assert_allclose(shared, expected, rtol=1e-12)
    assert (alpha > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["action", "parameter"])
def test_smoothing_gains_is_not_smoothing_actions(model):
    """Under action noise REINFORCE aims at grad J_sigma and smoothing of the gains at something else; under parameter noise not."""
    scene = Cartpole(sigma=1.0, noise=model)
    score, smoothing = (
        measured(scene, e, Jax(), SemiImplicitEuler(), samples=256, repeats=64)
        for e in (Reinforce(), RandomizedSmoothing())
    )
    assert score.indistinguishable
    assert smoothing.indistinguishable == (model == "parameter")
    if model == "action":
        assert smoothing.bias_low / smoothing.reference_norm > 0.05
        far = measured(Cartpole(sigma=3.0), Reinforce(), Jax(), SemiImplicitEuler(), samples=256, repeats=64)
        near = measured(
            Cartpole(sigma=3.0), RandomizedSmoothing(radius=0.1), Jax(), SemiImplicitEuler(), samples=256, repeats=64
        )
        assert far.variance_low > near.variance_high


def test_zeroth_orders_on_a_linear_cost_have_their_closed_form_errors():
    """Relative squared errors on a plane of d variables: (d + 1) / N, (d - 1) / N, and 0 for d orthogonal directions."""
    problem = Numpy().compile(compose(Linear(dimension=8)))
    theta, truth = problem.program.theta0, problem.program.closed_form_gradient()
    w = noise.draw(1, "plane", 4000, 8, 8, "cells")

    def error(estimator):
        return float(((estimator.estimate(problem, theta, w) - truth) ** 2).sum(axis=1).mean() / (truth @ truth))

    tolerance = 0.05  # 4,000 repeats: 2%
    assert error(RandomizedSmoothing()) == pytest.approx(9 / 8, rel=tolerance)
    assert error(SphereSmoothing()) == pytest.approx(7 / 8, rel=tolerance)
    assert error(Orthogonal(lengths="fixed")) < 1e-20
    assert error(Orthogonal()) < 0.5 * error(RandomizedSmoothing())
    assert error(ControlVariate()) < 1e-16  # what differences leave of the gradient at w = 0


def test_directions_on_a_plane_have_their_closed_form_errors():
    """The squared error d / N - 1 of N orthogonal directions (Choromanski et al. 2018), and 2 + 7 share of guided ones."""
    problem = Numpy().compile(compose(Linear(dimension=8)))
    truth, w = problem.program.closed_form_gradient(), noise.draw(2, "plane", 20_000, 2, 8, "cells")

    def mean(estimator):
        values = estimator.estimate(problem, problem.program.theta0, w)
        errors = ((values - truth) ** 2).sum(axis=1) / (truth @ truth)
        return values.mean(axis=0) @ truth / (truth @ truth), errors.mean()

    assert mean(Orthogonal(lengths="fixed"))[1] == pytest.approx(3.0, rel=0.01)
    assert mean(Guided(subspace=1, share=0.1)) == pytest.approx((1.0, 2.7), rel=0.03)  # 2.7 varies by 1%


@dataclass(frozen=True)
class Parabola(FunctionScene):
    """f = x^2 / 2 at theta = 1, so that a gradient is 1 + sigma w."""

    name = "parabola"
    continuous: ClassVar[bool] = True
    sigma: float = 1.0

    def theta0(self):
        return np.ones(1)

    def cost(self, xp, x):
        return 0.5 * x[0] * x[0]


def test_estimators_that_change_gradients_on_a_parabola():
    """Means where a gradient is N(1, 1): censored at 1 it is .6095 (Greene 2012, 19.3), otherwise 1."""
    problem, random = Numpy().compile(compose(Parabola())), np.random.default_rng(24)
    theta, (few, many) = problem.program.theta0, random.standard_normal((2, 200_000))
    cut = Clipped(limit=1.0).estimate(problem, theta, few.reshape(-1, 1, 1))
    assert cut.mean() == pytest.approx(0.6095, abs=0.006)  # four standard errors
    w = many.reshape(100, 2000, 1)
    corrected, fitted = ControlVariate().estimate_with_diagnostics(problem, theta, w)
    assert fitted["coefficient"].mean() == pytest.approx(1.0, abs=0.005)
    mixed, decided = TotalPropagation().estimate_with_diagnostics(problem, theta, w)
    assert decided["weight"].mean() == pytest.approx(5.75 / 6.75, rel=0.01)
    others = (e.estimate(problem, theta, w) for e in (AlphaOrder(), FiniteDifference()))
    for values in (corrected, mixed, *others):
        assert values.mean() == pytest.approx(1.0, abs=0.02)  # four standard errors of 200,000 samples, or more


@pytest.mark.parametrize(("limit", "by"), [(2.0, "sample"), (2.0, "element")])
def test_clipping_a_ramp_has_the_expectation_limit_times_chance(limit, by):
    scene = SoftHeaviside(nu=0.1)
    summary = measured(scene, Clipped(limit=limit, by=by), Numpy(step=1e-9))
    truth = scene.closed_form_gradient(None, None)[0]
    expected = truth - limit * scene.probability()
    assert summary.bias_low <= expected <= summary.bias_high


def test_clipping_a_batch_cuts_its_norm():
    problem = Numpy().compile(compose(Linear(dimension=8)))
    w = noise.draw(1, "plane", 3, 4, 8, "cells")
    values, decided = Clipped(by="batch", limit=0.5).estimate_with_diagnostics(problem, problem.program.theta0, w)
    assert np.linalg.norm(values, axis=1) == pytest.approx(0.5)
    assert (decided["cut"] == 1).all()


def test_a_measure_valued_gradient_has_no_variance_on_a_symmetric_cost():
    problem = Numpy().compile(compose(Heaviside()))
    w = noise.draw(1, "step", 5, 3, 1, "cells")
    values = MeasureValued().estimate(problem, problem.program.theta0, w)
    assert values == pytest.approx(3.98942, rel=1e-5)


def test_guided_directions_need_gradients_that_point_somewhere():
    """In the gradients' subspace it beats plain smoothing; where they vanish it keeps only its share of the gradient."""
    plane = Numpy().compile(compose(Linear(dimension=20)))
    w = noise.draw(1, "plane", 400, 20, 20, "cells")
    truth = plane.program.closed_form_gradient()
    errors = [
        float(((e.estimate(plane, plane.program.theta0, w) - truth) ** 2).sum(axis=1).mean())
        for e in (Guided(), RandomizedSmoothing())
    ]
    assert errors[0] < 0.5 * errors[1]
    step = Numpy().compile(compose(Heaviside()))
    w = noise.draw(1, "step", 400, 64, 1, "cells")
    kept = Guided().estimate(step, step.program.theta0, w).mean() / 3.98942
    # exactly: the smoothing shrinks too, so that what is kept is sqrt(share), as differences of a step do not scale
    assert kept == pytest.approx(0.1**0.5, rel=0.1)


def test_total_propagation_weights_each_step_by_itself():
    """Weights equal v0 / (v0 + v1) of each control, recomputed from the terms of single samples."""
    program = compose(Pushing(horizon=4, sigma=0.1), Penalty(stiffness=1e3), SemiImplicitEuler())
    problem = Numpy().compile(program)
    w = noise.draw(0, "pushing", 2, 16, 4, "cells")
    values, decided = TotalPropagation().estimate_with_diagnostics(problem, program.theta0, w)
    single = w.reshape(32, 1, 4)
    first, zeroth = (e.estimate(problem, program.theta0, single).reshape(2, 16, 4) for e in (Fobg(), Reinforce()))
    v1, v0 = first.var(axis=1, ddof=1), zeroth.var(axis=1, ddof=1)
    np.testing.assert_allclose(decided["weight"], v0 / (v0 + v1), rtol=1e-9)
    expected = decided["weight"] * first.mean(axis=1) + (1 - decided["weight"]) * zeroth.mean(axis=1)
    np.testing.assert_allclose(values, expected, rtol=1e-9)
