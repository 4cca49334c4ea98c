"""Estimators against closed-form biases and variances, and where two of them really differ."""

import math

import numpy as np
import pytest
from bench.plugins.scenes.linear import Linear
from classes import (
    AlphaOrder,
    Clipped,
    ControlVariate,
    FiniteDifference,
    Guided,
    Numpy,
    Plain,
    PlainDifference,
    RandomizedSmoothing,
    Reinforce,
    SoftHeaviside,
    SphereSmoothing,
    Torch,
)
from helpers import loaded

import bench
from bench.measure import noise
from bench.model import compose
from bench.run.session import RunSession

SIGMA, SAMPLES, REPEATS = 0.1, 200, 400


# Exact derivatives throughout: the differences of the numpy backend see a jump when a sample falls within a step of it.


def test_confidence_radius_uses_the_failure_probability():
    """eps = sqrt(2 V ln((d+1)/delta)/N) + 2 L ln((d+1)/delta)/(3 N): at its edge the weight drops to 0."""
    scene, n = SoftHeaviside(nu=0.2), 400
    problem = Torch().compile(compose(scene))
    w = noise.draw(3, scene.name, 1, n, 1, "cells")
    centred = Reinforce(baseline="center")
    zeroth = centred.estimate(problem, scene.theta0(), w[:, n // 2 :])
    terms = np.array([centred.estimate(problem, scene.theta0(), w[:, i : i + 1])[0, 0] for i in range(n // 2, n)])
    log_term = math.log(2 / 0.05)
    eps = math.sqrt(2 * terms.var(ddof=1) * log_term / (n // 2)) + 2 * abs(terms).max() / (3 * (n // 2)) * log_term
    methods = (AlphaOrder(gamma=eps * factor, sharing="split") for factor in (0.999, 1.001))
    below, above = (method.estimate(problem, scene.theta0(), w) for method in methods)
    assert below == pytest.approx(zeroth, rel=1e-12)
    assert above[0, 0] != below[0, 0]
    assert abs(above - below).max() <= 0.0011 * eps


ON_A_PLANE = [
    (RandomizedSmoothing(), 8, 9 / 8),
    (RandomizedSmoothing(variant="forward"), 8, 9 / 8),
    (FiniteDifference(), 8, 0.0),
    (SphereSmoothing(), 8, 7 / 8),
    (ControlVariate(), 8, 0.0),  # what differences leave of the gradient at w = 0
    (Guided(subspace=1, share=0.1), 2, 2.7),
]
"""Estimator, samples, and the relative squared error on a plane of 8 variables.

It is (d + 1) / N of a normal, (d - 1) / N of a sphere, and 2 + 7 share of guided ones.
"""


def error_on_a_plane(estimator, samples):
    problem = Numpy().compile(compose(Linear(dimension=8)))
    truth, w = problem.program.closed_form_gradient(), noise.draw(2, "plane", 5000, samples, 8, "cells")
    values = estimator.estimate(problem, problem.program.theta0, w)
    return ((values - truth) ** 2).sum(axis=1).mean() / (truth @ truth)


@pytest.mark.parametrize(("estimator", "samples", "error"), ON_A_PLANE, ids=str)
def test_errors_on_a_plane_are_their_closed_forms(estimator, samples, error):
    assert error_on_a_plane(estimator, samples) == pytest.approx(error, rel=0.06, abs=1e-16)  # 2.7 varies by 2%


def test_clipping_a_batch_cuts_its_norm():
    problem = Numpy().compile(compose(Linear(dimension=8)))
    w = noise.draw(1, "plane", 3, 4, 8, "cells")
    values, decided = Clipped(by="batch", limit=0.5).estimate_with_diagnostics(problem, problem.program.theta0, w)
    assert np.linalg.norm(values, axis=1) == pytest.approx(0.5)
    assert (decided["cut"] == 1).all()


@pytest.mark.parametrize(("estimator", "gradients", "rollouts"), [(Plain(), 1, 0), (PlainDifference(), 0, 12)], ids=str)
def test_the_plain_gradient_takes_one_draw_of_the_scenes_own_noise_and_no_other(estimator, gradients, rollouts):
    problem = bench.problem("cartpole_swing[horizon=5]", backend="torch")
    theta, w = problem.program.theta0, noise.draw(0, "plain", 3, 8, problem.program.n_noise, "cells")
    problem.reset_usage()
    found = estimator.estimate(problem, theta, w)
    assert (problem.usage.gradients, problem.usage.rollouts) == (3 * gradients, 3 * rollouts)
    own = np.where(np.arange(w.shape[2]) < w.shape[2] - problem.program.exogenous, 0.0, w[:, 0]).T
    np.testing.assert_allclose(found, problem.grad(theta, own).T, rtol=1e-6)  # differences agree to 9 digits
    assert len(np.unique(found[:, 0])) == 3


@pytest.mark.parametrize("estimator", ["plain", "plain_difference"])
@pytest.mark.parametrize("scene", ["pushing[horizon=5]", "heaviside[theta=0.05]"])
def test_a_row_of_the_plain_gradient_has_no_variance_and_no_remark(estimator, scene, tmp_path):
    made, (cell,) = loaded(
        f"scenes=[{scene}]",
        "backends=[numpy]",
        f"estimators=[{estimator}]",
        "samples=8",
        "repeats=4",
        "timing=false",
        "reference.samples=4096",
        f"results_dir={tmp_path}",
    )
    row = made.study.measure(cell, RunSession(made))
    assert (row["variance"], row["variance_high"]) == (0.0, 0.0)
    assert row["bias_low"] <= row["bias"] <= row["bias_high"]
    assert row["gradients"] + row["rollouts"] == (1 if estimator == "plain" else 2 * len(row["point"]))
    assert "identical" not in row["reason"]
