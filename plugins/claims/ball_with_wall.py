"""C3: a thrown ball and a wall. A descent on first-order gradients stops where the wall begins."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import bisect, brentq

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import centre, descend, estimator, function, means, moments, problem, rule, stochastic_descent
from bench.model import Array, Problem

GRAVITY, WALL, HEIGHT, SIGMA = 9.81, 0.06, 0.02, 0.1
RUNS = 60
EDGES = (
    ("first jump", "0.69320", 0.6832, 0.7032),
    ("second jump", "1.19935", 1.18935, 1.20935),
    ("first kink", "0.31467", 0.25, 0.4),
    ("second kink", "1.25613", 1.21, 1.4),
)
"""Angles at which the ball begins or ceases to stop at the wall, as published, each with a range around it."""


def ball_with_wall(xp: Any, x: Array) -> Array:
    """A ball thrown at speed 1 and angle x stops at a wall unless it clears it: f = -(distance reached)^2."""
    angle = x[0]
    reached = xp.sin(2 * angle) / GRAVITY
    flight = WALL / xp.cos(angle)
    height = flight * xp.sin(angle) - 0.5 * GRAVITY * flight * flight
    stopped = (reached > WALL) & (height <= HEIGHT)
    landed = xp.where(stopped, 0.0 * reached + WALL, reached)
    return -landed * landed


SCENE = function(ball_with_wall, [0.1], SIGMA, continuous=False)


class ThrownBall(Claim):
    """Throwing over a wall."""

    name = "C3"
    lesson = "Low variance is not low bias"
    statement = (
        "Thrown at a wall, a ball's first-order gradient leads a descent to the wall (angle 0.495); zeroth and alpha order "
        "pass it (0.833)."
    )
    source = "Suh et al. 2022, ICML"
    learned = (
        "A jump hides the way on from a first-order gradient. And read a method's settings: a fixed accuracy far below what "
        "the samples can resolve turns alpha-order into the zeroth order."
    )
    quantity = "gradient of the smoothed cost"
    marks = (("y", 0.0, ""),)
    quick = False

    def measure(self) -> Outcome:
        """Locate the jumps and kinks, integrate the gradients, and run the descents."""
        at, orders = problem(SCENE), (estimator("fobg"), estimator("reinforce[baseline=none]"))

        def is_stopped(x: float) -> bool:
            cost = at.value(np.array([x]), np.zeros((1, 1)))[0]
            return bool(abs(cost + WALL * WALL) < 1e-12)

        def mean(order: int, x: float) -> tuple[float, float]:
            return moments(at, orders[order], x, 200_000)[0]

        lowest = brentq(lambda x: mean(1, x)[0], 0.8, 0.93, xtol=1e-7)
        false_zero = brentq(lambda x: mean(0, x)[0], 0.69, 0.78, xtol=1e-6)
        figures = [
            # positions are published to one unit of their last digit: the second jump is at 1.199344
            *(
                Figure(what, text, float(bisect(lambda x: is_stopped(x) - 0.5, *ends, xtol=1e-9)), spread=1e-5)
                for what, text, *ends in EDGES
            ),
            Figure("lowest point of the smoothed cost", "0.861466", lowest, 1e-6),
            Figure("false zero of the first-order mean", "0.73", false_zero),
        ]
        for text, x in (("0.0257", 0.695), ("0.01665", 0.6), ("4.0e-4", 1.0)):
            (a, a_error), (b, b_error) = mean(0, x), mean(1, x)
            figures.append(Figure(f"bias at {x}", text, abs(a - b), max(a_error, b_error)))
        first = centre(stochastic_descent(at, False, 0.1, 1000, seed=3))
        zeroth = centre(stochastic_descent(at, True, 0.1, 1000, seed=33))
        noise = np.random.default_rng(333).standard_normal((1000, 1, RUNS * 50))
        (mixed, off), (_, off_with_baseline) = (_alpha_order_descent(at, noise, baseline) for baseline in (0.0, 1.0))
        code = estimator("alpha_order[gamma=0.01,delta=0.95,sharing=shared]")
        decided = code.estimate_with_diagnostics(at, np.array([0.1]), noise[:, 0, :50, None])[1]["alpha"]
        exact = _exact_descent(at)
        late = int(np.argmax(exact >= 0.8331))
        figures += [
            Figure("end of the descent on the exact gradient", "0.8515", float(exact[-1]), spread=0.0035),
            Figure("end of the first-order descent", "0.494", *first, spread=0.003),
            Figure("end of the zeroth-order descent", "0.8515", *zeroth, spread=0.0035),
            Figure("end of the alpha-order descent, as published", "0.8515", *centre(mixed), spread=0.0035),
            # the source's 0.98 is from one run, so its spread is the spread between runs
            Figure("share of its estimates with alpha = 0", "0.98", *centre(off), spread=2 * float(off.std(ddof=1))),
        ]
        grid = np.linspace(0.1, 1.4, 60)
        return Outcome(
            figures,
            reservation=(
                f"alpha is 0 in {off.mean():.0%} of the alpha-order estimates at the published accuracy of 0.01, so that its "
                f"curve is the zeroth order's. With f(theta) subtracted it is 0 in {off_with_baseline.mean():.0%}, and with the failure "
                f"probability of 0.95 that the published code passes in {np.mean(decided == 0):.0%} of those at the start. The source's own "
                f"end of the zeroth-order descent, 0.8331, lies outside what 20 runs give, {zeroth[0]:.4f}. The exact "
                f"gradient ends at {exact[-1]:.4f}, and passes 0.8331 after {late} of the 1,000 steps, still moving: a few "
                "steps fewer would explain the difference"
            ),
            series={"angle [rad]": grid}
            | {name: means(at, orders[i], grid, 20_000) for i, name in ((1, "true"), (0, "first-order mean"))},
        )


def _exact_descent(at: Problem) -> np.ndarray:
    """Return the path of descent on the gradient of the smoothed cost, by quadrature."""
    nodes, weights = rule(8000)
    return descend(lambda theta, _: (at.value(theta, nodes) * nodes[0]) @ weights / SIGMA, np.array([0.1]), 0.1, 1000)[
        :, 0
    ]


def _alpha_order_descent(at: Problem, noise: np.ndarray, baseline: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of descents on the published alpha order, and their shares of steps with alpha = 0.

    The accuracy is 0.01 and the failure probability 0.05. Implemented here since the estimator of this package always
    uses the cost at w = 0 as baseline.
    """
    n, log_term, off = noise.shape[2] // RUNS, np.log(2 / 0.05), np.zeros((len(noise), RUNS))

    def step(theta: np.ndarray, i: int) -> np.ndarray:
        every, w = np.repeat(theta, n)[None], noise[i]
        base = np.repeat(at.value(theta[None], np.zeros((1, RUNS))), n)
        zeroth = ((at.value(every, w) - baseline * base) * w[0] / SIGMA).reshape(RUNS, n)
        first = at.grad(every, w)[0].reshape(RUNS, n)
        v0, v1 = zeroth.var(axis=1, ddof=1), first.var(axis=1, ddof=1)
        eps = np.sqrt(2 * v0 * log_term / n) + 2 * np.abs(zeroth).max(axis=1) / (3 * n) * log_term
        m1, m0 = first.mean(axis=1), zeroth.mean(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            alpha = np.fmin(v0 / (v0 + v1), (0.01 - eps) / np.abs(m1 - m0))
        off[i] = eps > 0.01
        alpha = np.where((eps > 0.01) | ~np.isfinite(alpha), 0.0, alpha)
        return np.asarray(alpha * m1 + (1 - alpha) * m0)

    return descend(step, np.full(RUNS, 0.1), 0.1, len(noise))[-1], off.mean(axis=0)
