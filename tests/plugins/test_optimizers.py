"""Optimizers against their closed forms and torch.optim."""

import numpy as np
import pytest
from bench.plugins.optimizers.cma_es import CmaEs
from bench.plugins.optimizers.ppo import Ppo
from classes import Adam, Cem, GaussNewton, GradientDescent, Momentum, Mppi
from scipy.stats import norm

from bench.model import Answer

SAMPLES = 400_000
"""Samples of the population methods' limits: the mean of a normal is then known to 0.0016 standard deviations."""
LIMIT = 0.01
"""Six standard errors at that many samples."""
SAME = 1e-12
"""Relative difference from other implementations of the same formula, after 100 updates."""


def gradients(dim=5, steps=100):
    """Gradients of any size, some of them above every limit."""
    rng = np.random.default_rng(1)
    return rng.standard_normal((steps, dim)) * np.exp(rng.standard_normal((steps, 1)))


def path(optimizer, found):
    state = optimizer.start(np.ones(found.shape[1]))
    for gradient in found:
        points = optimizer.ask(state, np.empty((found.shape[1], 0)))
        state = optimizer.tell(state, points, Answer(gradient=gradient[:, None]))
    return state["theta"]


CASES = {
    "gradient_descent": (GradientDescent(rate=0.02), lambda t, p: t.optim.SGD([p], lr=0.02)),
    "momentum": (Momentum(rate=0.02), lambda t, p: t.optim.SGD([p], lr=0.02, momentum=0.9)),
    "nesterov": (
        Momentum(rate=0.02, nesterov=True),
        lambda t, p: t.optim.SGD([p], lr=0.02, momentum=0.9, nesterov=True),
    ),
    "adam": (Adam(rate=0.02), lambda t, p: t.optim.Adam([p], lr=0.02)),
    "adam, clipped by norm": (Adam(rate=0.02, clip=1.0), lambda t, p: t.optim.Adam([p], lr=0.02)),
}


@pytest.mark.parametrize("case", CASES)
def test_100_updates_are_those_of_torch(case):
    torch = pytest.importorskip("torch")
    optimizer, theirs = CASES[case]
    parameter = torch.ones(5, dtype=torch.float64, requires_grad=True)
    method = theirs(torch, parameter)
    for gradient in gradients():
        parameter.grad = torch.tensor(gradient)
        if optimizer.clip is not None:
            # not torch's own function, which divides by norm + 1e-6
            parameter.grad *= min(1.0, optimizer.clip / float(np.linalg.norm(gradient)))
        method.step()
    assert path(optimizer, gradients()) == pytest.approx(parameter.detach().numpy(), rel=SAME)


@pytest.mark.parametrize(("share", "factor"), [(0.1, 0.169135), (0.2, 0.218643)])
def test_cem_on_a_linear_cost(share, factor):
    """The mean moves by -sigma phi(z)/rho, the variance by 1 - z phi/rho - (phi/rho)^2 (z the quantile of rho)."""
    move = -norm.pdf(norm.ppf(share)) / share
    optimizer = Cem(population=SAMPLES, elites=int(share * SAMPLES), width=0.7)
    state = optimizer.start(np.array([2.0, 0.0]))
    points = optimizer.ask(state, np.random.default_rng(0).standard_normal((2, SAMPLES)))
    after = optimizer.tell(state, points, Answer(value=3.0 * points[0]))
    assert after["theta"] == pytest.approx([2.0 + 0.7 * move, 0.0], abs=LIMIT)
    assert (after["deviation"] / 0.7) ** 2 == pytest.approx([factor, 1.0], abs=LIMIT)


def test_mppi_on_a_bowl():
    """With H = 1, lambda = .1, S = .09 the mean goes from 0 to .473684 of the way."""
    optimizer = Mppi(population=SAMPLES, width=0.3, temperature=0.1, relative=False)
    state = optimizer.start(np.zeros(1))
    points = optimizer.ask(state, np.random.default_rng(0).standard_normal((1, SAMPLES)))
    after = optimizer.tell(state, points, Answer(value=0.5 * (points[0] - 2.0) ** 2))
    assert after["theta"] == pytest.approx([2 * 0.473684], abs=LIMIT)


def test_slope_of_ppo_is_that_of_its_loss():
    """The clipped surrogate as written in the paper, differentiated at a policy that has moved from the old one."""
    rng = np.random.default_rng(0)
    old, moved = (np.stack([rng.standard_normal(3), rng.uniform(-0.5, 0.5, 3)]) for _ in range(2))
    points = old[0][:, None] + np.exp(old[1])[:, None] * rng.standard_normal((3, 50))
    advantage = rng.standard_normal(50)

    def loss(policy):
        after, before = (norm.logpdf(points, p[0][:, None], np.exp(p[1])[:, None]) for p in (policy, old))
        ratio = np.exp(after - before)
        return np.minimum(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage).mean(axis=1).sum()

    shifts = 1e-6 * np.eye(6).reshape(6, 2, 3)
    slope = [(loss(moved + shift) - loss(moved - shift)) / 2e-6 for shift in shifts]
    assert Ppo().slope(moved, old, points, advantage).ravel() == pytest.approx(slope, rel=1e-7)


def test_gauss_newton_takes_back_a_bad_step():
    """On arctan(x) as residual and gradient, undamped steps diverge from |x| > 1.39."""
    optimizer = GaussNewton()
    state = optimizer.start(np.array([3.0]))
    for _ in range(60):
        x = optimizer.ask(state, np.empty((1, 0)))
        state = optimizer.tell(state, x, Answer(0.0 * x[0], np.arctan(x), np.arctan(x), 1 / (1 + x[None] ** 2)))
    assert abs(state["theta"][0]) < 1e-6


def test_nothing_finite_is_no_step():
    for optimizer in (Cem(population=4, elites=2), Mppi(population=4), CmaEs(population=4), Ppo(population=4)):
        state = optimizer.start(np.zeros(2))
        points = optimizer.ask(state, np.random.default_rng(0).standard_normal((2, 4)))
        after = optimizer.tell(state, points, Answer(value=np.full(4, np.nan)))
        assert np.isfinite(after["theta"]).all()
