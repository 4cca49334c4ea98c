"""Optimizers against their closed forms, torch.optim and the constants of cma."""

import numpy as np
import pytest
from bench.plugins.optimizers.cma_es import CmaEs, constants
from bench.plugins.optimizers.ppo import Ppo
from classes import Adam, Cem, GaussNewton, GradientDescent, Lbfgs, LineSearch, Momentum, Mppi
from scipy.stats import norm

from bench.conformance import optimizers as kit
from bench.conformance.kit import Failed
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


def test_decay_of_the_rate():
    assert path(GradientDescent(rate=1.0, decay=1.0), np.ones((4, 1))) == pytest.approx(
        [1 - (1 + 1 / 2 + 1 / 3 + 1 / 4)]
    )


@pytest.mark.parametrize(("dim", "population"), [(2, 6), (5, 8), (10, 10), (100, 17)])
def test_constants_of_cma(dim, population):
    """At the default populations; for larger ones cma damps the step size more."""
    cma = pytest.importorskip("cma")
    search = cma.CMAEvolutionStrategy(dim * [0.0], 1.0, {"popsize": population, "verbose": -9, "seed": 1})
    search.adapt_sigma.initialize(search)
    theirs, size, ours = search.sp, search.adapt_sigma, constants(dim, population)
    assert ours.weights == pytest.approx(list(theirs.weights)[: population // 2], rel=SAME)
    assert ours.mu_eff == pytest.approx(theirs.weights.mueff, rel=SAME)
    assert (ours.c_c, ours.c_1, ours.c_mu) == pytest.approx((theirs.cc, theirs.c1, theirs.cmu), rel=SAME)
    assert (ours.c_sigma, ours.d_sigma) == pytest.approx((size.cs, size.damps), rel=SAME)


def steps(optimizer, cost, slope, count, start=1.0, curvature=np.ones_like):
    """Thetas, ``(count + 1,)``. The residual of a least-squares method is the gradient."""
    state = optimizer.start(np.array([start]))
    found = [start]
    for _ in range(count):
        x = optimizer.ask(state, np.empty((1, 0)))
        state = optimizer.tell(state, x, Answer(cost(x[0]), slope(x), slope(x), curvature(x)[None]))
        found.append(float(state["theta"][0]))
    return found


def test_a_line_search_takes_the_first_step_with_sufficient_descent():
    """Armijo 1966: on 50 x^2 the first accepted rate is .004, and the second step has the same."""
    assert steps(LineSearch(), lambda x: 50.0 * x**2, lambda x: 100.0 * x, 2)[2] == pytest.approx(0.6, rel=SAME)


def test_lbfgs_steps_along_the_secant():
    """From 1 to .9, then along the secant of the gradient x + x^2 (Nocedal, Wright 2006, chapter 6)."""
    found = steps(Lbfgs(), lambda x: 0.5 * x**2 + x**3 / 3, lambda x: x + x**2, 4)
    assert found[2] == pytest.approx(0.9, rel=SAME)
    assert found[4] == pytest.approx(0.9 - 0.1 * 1.71 / (2.0 - 1.71), rel=1e-9)


def test_a_damped_step_of_gauss_newton():
    """Marquardt 1963: the share damping / (1 + damping) remains."""
    found = steps(GaussNewton(damping=0.001), lambda x: 0.5 * x**2, lambda x: x, 2)
    assert found[2] == pytest.approx(0.001 / 1.001, rel=1e-9)


def test_gauss_newton_takes_back_a_bad_step():
    found = steps(GaussNewton(), lambda x: 0.0, np.arctan, 60, 3.0, lambda x: 1 / (1 + x**2))
    assert abs(found[-1]) < 1e-6  # undamped steps diverge from |x| > 1.39


def test_nothing_finite_is_no_step():
    for optimizer in (Cem(population=4, elites=2), Mppi(population=4), CmaEs(population=4), Ppo(population=4)):
        state = optimizer.start(np.zeros(2))
        points = optimizer.ask(state, np.random.default_rng(0).standard_normal((2, 4)))
        after = optimizer.tell(state, points, Answer(value=np.full(4, np.nan)))
        assert np.isfinite(after["theta"]).all()


# ------------------------------------------------------------------------------------------------ planted faults


class Forgetful(GradientDescent):
    """It keeps the iteration outside its state."""

    def step(self, state, gradient):
        counts = self.__dict__.setdefault("counts", [0])
        counts[0] += 1
        return {"theta": state["theta"] - 0.1 / counts[0] * gradient, "iteration": 0}


class Careless(GradientDescent):
    """It changes the state it was given."""

    def step(self, state, gradient):
        state["theta"] -= 0.1 * gradient
        return {"theta": state["theta"].copy(), "iteration": state["iteration"]}


class Greedy(Cem):
    """It declares a need that it never has."""

    needs = frozenset({"value", "gradient"})

    def required_fields(self, state):
        return frozenset({"value"})


class Climbing(GradientDescent):
    """The wrong sign."""

    def step(self, state, gradient):
        return {"theta": state["theta"] + 0.1 * gradient, "iteration": 0}


@pytest.mark.parametrize(
    ("fault", "check", "message"),
    [
        (Forgetful(), kit.path_repeats_after_a_stop, "takes another path"),
        (Careless(), kit.state_is_left_alone, "has changed the state"),
        (Greedy(), kit.needs_are_declared, "declares"),
        (Climbing(), kit.descends_on_a_bowl, "the cost goes from"),
    ],
)
def test_kit_catches(fault, check, message):
    with pytest.raises(Failed, match=message):
        check(fault)
