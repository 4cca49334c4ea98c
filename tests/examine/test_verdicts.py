"""One table of verdicts: a cost, a gradient and settings give this status and this cause."""

import math
from functools import partial

import mechanisms
import numpy as np
import pytest
from scipy.optimize import brentq

import bench

swing, START = mechanisms.swinging, [0.7, 0.3]
ADAPTIVE = [1.0, 1.0, 0.5]
RANDOM, POINT = np.random.default_rng(0), np.array([0.3, -0.7, 1.1])
slope, shared = partial(mechanisms.swinging, slope=True), partial(mechanisms.swinging, shared=True, slope=True)


def smooth(x):
    return float(2.0 * np.sin(x).sum() + x[0] * x[1])


def smooth_slope(x):
    return 2.0 * np.cos(x) + [x[1], x[0], 0.0]


def scaled(factor, gradient=slope):
    return lambda x, **steps: factor * np.asarray(gradient(x, **steps))


def offset(size):
    return lambda x: smooth(x) + size


def single(size):
    return lambda x: np.float32(np.float32(size) + np.float32(smooth(x)))


def noisy(x):
    return swing(x) + 1e-7 * RANDOM.standard_normal()


def pressed(x):
    """A ball on points: compiled code calls a function for each contact."""
    touched = [x[0] - point for point in np.linspace(-1.0, 1.0, 41) if point < x[0]]
    return sum(map(lambda depth: depth**3, touched)) + 0.02 * x[0] * x[1] + 0.5 * np.sin(x[1])


def without_friction(x):
    depths = np.maximum(x[0] - np.linspace(-1.0, 1.0, 41), 0.0)
    return np.array([3.0 * (depths**2).sum() + 0.02 * x[1], 0.5 * np.cos(x[1])])


def coupled(x):
    """A loop of Newton's method, whose length depends on theta."""
    z = 1.0
    while abs(z**3 + 1.3 * z - x[0]) > 1e-13:
        z -= (z**3 + 1.3 * z - x[0]) / (3.0 * z * z + 1.3)
    return (10.0 + 0.2 * x[1]) * z + 0.3 * np.sin(x[1]), (10.0 + 0.2 * x[1]) / (3.0 * z * z + 1.3)


def root(x, xtol=1e-3):
    return brentq(lambda z: z**3 + x[0] * z - x[1], -5.0, 5.0, xtol=xtol)


def root_slope(x):
    z = root(x)
    return np.array([-z, 1.0]) / (3.0 * z * z + x[0])


def hashed(x):
    return swing(x) + 0.38 * np.random.default_rng(int(np.frombuffer(x.tobytes(), np.uint32).sum())).standard_normal()


def henon(steps, x, dq=0.0, dp=0.0):
    q, p = map(float, x)
    for _ in range(steps):
        q, p, dq, dp = 1 - 1.4 * q * q + p, 0.3 * q, -2.8 * q * dq + dp, 0.3 * dq
    return q, dq


def chaos(steps):
    """The Henon map: after 60 steps the gradient itself explains that neighbours differ; after 3,000 it is inf - inf."""
    return lambda x: henon(steps, x)[0], lambda x: [henon(steps, x, 1.0)[1], henon(steps, x, 0.0, 1.0)[1]]


def fails_elsewhere(x):
    if abs(x[0] - START[0]) > 1e-3:
        raise RuntimeError("line one\nline two " * 100)
    return 75300 * slope(x)


def lagging(x):
    held.append(np.array(x))
    return slope(held[-2])


def small_slope(x):
    return 1e6 * np.sin(x[0]) + 1e-6 * x[1] + x[2]


def with_small(second):
    return lambda x: [1e6 * np.cos(x[0]), second, 1.0]


def residue(size):
    return lambda x: float(np.sin(x[0]) - size * x[1])


def by_size(second):
    return lambda x: [np.cos(x[0]), second]


def bent(bend):
    """The slope changes at theta by little, where 9 steps of a decade do not show it over three decades of noise."""

    def cost(x):
        rough = 1e-14 * np.sin(1e17 * x.sum())
        return float(0.02 * np.sin(x[0]) + 0.1 * x[1] ** 2 + bend * abs(x[0] - 0.3 + x[1] - 0.9) + rough)

    return cost


def side(bend, factor):
    return lambda x: np.array([0.02 * np.cos(0.3) + factor * bend, 0.2 * 0.9 + factor * bend])


def steps_of(x):
    return float(np.sin(x[0]) * x[1] + 2e-4 * np.floor(1000 * x[0] + 0.5))


def starting(x):
    return float(np.sin(x[0]) + x[1] ** 2)


def rounded(x):
    return np.round(20.0 * x) / 20.0


def latent(x, w):
    """For each draw the cost is flat, and the mean over draws is not."""
    return float(np.mean(np.round(x[0] + w)) ** 2)


held = [START]
NARROW = 0.02
"""Standard deviation of the noise on the input of a smoothed square."""


def square(x, w):
    return float((x[0] + NARROW * w[0]) ** 2)


def score(factor):
    """An estimator without a baseline: its draws are nearly linear in w, as the slopes are."""
    return lambda x, w: [factor * square(x, w) * w[0] / NARROW]


def chance(x):
    return 1.0 / (1.0 + math.exp(-x[0]))


def thrown(x, w):
    """J = x p(x) with a Bernoulli factor: each draw's gradient is its slope times 1 + x (1 - p)."""
    return float(x[0] * math.exp(0.3 * w[1]) * (0.5 * math.erfc(-w[0] / math.sqrt(2.0)) < chance(x)))


def lost(value, w):
    """A gradient that is not a number at one draw in 72."""
    return [value if w[0] < 2.2 else math.nan]


def steep(x):
    return np.tanh((x[0] - 1.003) / 1e-4) + 0.1 * x[0]


def kinked(x):
    return float(abs(x[0] - 1.0))


def wide(x):
    return float(x[0] ** 2)


def float32(is_mixed):
    return lambda x: mechanisms.single(x, is_mixed)


def separate(x, **settings):
    return mechanisms.separate(x, 1e-3, **settings)


adaptive, frozen = (partial(one, rtol=1e-3) for one in (mechanisms.adaptive, mechanisms.frozen))
treads = {"theta": [1.0], "sigma": 0.1}
SOFT = {"theta": [1.0], "noise": 1, "calls": 8000}
DEAD = swing, lambda x: [*slope(x[:2]), 0.0]
"""The third input has no effect."""
QUICK = {"theta": [0.12, -1.0], "calls": 30}
CASES = {
    "an exception of the gradient": (1, "raised", swing, lambda x: 1 / 0, {}),
    "700 calls, as a solver of 50 ms has in a minute": (
        3,
        "adaptive",
        adaptive,
        frozen,
        {"theta": ADAPTIVE, "calls": 700},
    ),
    "an adjoint that is solved separately": (3, "adaptive", adaptive, separate, {"theta": ADAPTIVE}),
    "jumps of a program with fixed steps excuse nothing": (
        1,
        "wrong_factor",
        lambda x: swing(x) + 1e-4 * np.floor(x[0] * 300 + 0.4),
        scaled([1.02, 1.0]),
        {},
    ),
    "shared memory": (1, "overwritten", swing, shared, {"horizons": [1, 2, 5, 20]}),
    "wrong at the first horizon": (
        1,
        "missing_term",
        swing,
        lambda x, steps=20: (1.01 if steps < 10 else 1.0) * slope(x, steps),
        {"horizons": (1, 5, 20)},
    ),
    "noise above the last digits": (1, "wrong_factor", noisy, scaled(2.0), {}),
    "noise of the cost": (3, "noisy", noisy, slope, {}),
    "expected noise of the cost": (0, "noisy", noisy, slope, {"expect": "noisy"}),
    "noise of the gradient too": (3, "noisy", noisy, lambda x: slope(x) * RANDOM.normal(1.0, 1e-3), {}),
    "a wrong sign beside that noise": (
        1,
        "",
        noisy,
        lambda x: slope(x) * RANDOM.normal(-1.0, 1e-3),
        {"expect": "noisy"},
    ),
    "a random gradient is not expected": (3, "noisy", noisy, lambda x: RANDOM.standard_normal(2), {"expect": "noisy"}),
    "a loop in map": (1, "missing_term", pressed, without_friction, {"theta": [0.31, 0.4]}),
    "a term beside a solver's loop": (
        1,
        "missing_term",
        lambda x: coupled(x)[0],
        lambda x: np.array([coupled(x)[1], 0.3 * np.cos(x[1])]),
        {"theta": [0.9, 0.4]},
    ),
    "a multiple of a noisy gradient": (
        1,
        "",
        noisy,
        lambda x: slope(x) * [1.0, 50.0] * RANDOM.normal(1.0, 1e-3),
        {},
    ),
    "noise of the gradient alone": (1, "nondeterministic", swing, lambda x: slope(x) * RANDOM.normal(1.0, 0.1), {}),
    "a root to a thousandth": (3, "adaptive", root, root_slope, {"theta": [1.3, 0.9]}),
    "a third too much of a root to a millionth": (
        1,
        "",
        partial(root, xtol=1e-6),
        lambda x: 1.3 * root_slope(x),
        {"theta": [1.3, 0.9]},
    ),
    "a warm start": (
        1,
        "nondeterministic",
        mechanisms.WarmStarted().cost,
        mechanisms.WarmStarted.gradient,
        {"theta": [1.0, 2.0]},
    ),
    "single precision inside": (0, "", float32(True), mechanisms.single_gradient, {}),
    "a factor in single precision": (1, "wrong_factor", float32(True), scaled(1.55, mechanisms.single_gradient), {}),
    "a third of a percent in single precision": (
        1,
        "",
        lambda x: np.float32(x[1]) * np.float32(x[0]) ** 2,
        lambda x: [2.006 * x[0] * x[1], x[0] ** 2],
        {},
    ),
    "a seed taken from theta": (1, "rough", hashed, slope, {}),
    "chaos": (3, "unsettled", *chaos(60), {"theta": [0.1, 0.1], "calls": 1500}),
    "an overflow": (1, "nan_gradient", *chaos(3000), {"theta": [0.1, 0.1], "calls": 1500}),
    "below the rounding of a cost that stays": (3, "constant", lambda x: 0.04, lambda x: [-2.5e-16, -4.7e-18], QUICK),
    "an exception elsewhere": (1, "", swing, fails_elsewhere, {}),
    "the gradient of the call before": (1, "", swing, lagging, {"calls": 400}),
    "an input without effect": (0, "", *DEAD, {"theta": [*START, 1.0]}),
    "an input that must have one": (1, "no_effect", *DEAD, {"theta": [*START, 1.0], "allow_zero": False}),
    "rounding hides the slope": (3, "unresolved", offset(1e13), smooth_slope, {"theta": POINT, "calls": 800}),
    "a slope below rounding": (3, "unresolved", lambda x: 1e6 + 2e-8 * x[0], lambda x: [0.0], {"theta": [1.0]}),
    "a float32 cost far from zero": (3, "", single(1e5), scaled(-1.0, smooth_slope), {"theta": POINT, "calls": 800}),
    "a float32 slope that is known to 4%": (
        3,
        "unresolved",
        single(3e3),
        scaled(1.04, smooth_slope),
        {"theta": POINT, "calls": 800},
    ),
    "a small component": (0, "", small_slope, with_small(1e-6), {"theta": POINT, "calls": 1500}),
    "a small component that is wrong": (
        3,
        "unresolved",
        small_slope,
        with_small(1e-3),
        {"theta": POINT, "calls": 1500},
    ),
    "what a solver leaves of a derivative of 0": (3, "unresolved", residue(1e-6), by_size(8e-8), {}),
    "the same is not expected away": (3, "unresolved", residue(1e-6), by_size(8e-8), {"expect": "unresolved"}),
    "a small slope with the wrong sign": (1, "", residue(1e-6), by_size(1e-6), {}),
    "a small slope beside an undefined one": (
        1,
        "",
        lambda x: float(x[0] > 0.9) + 3e-9 * np.sin(x[1]),
        lambda x: [0.0, 1e-9 * np.cos(x[1])],
        {"theta": [0.9, 0.3]},
    ),
    "a factor of an input that is nearly 0": (
        3,
        "unresolved",
        starting,
        lambda x: [1.5 * np.cos(x[0]), 2 * x[1]],
        {"theta": [1e-12, 1.0]},
    ),
    "the same with its scale": (
        1,
        "",
        starting,
        lambda x: [1.5 * np.cos(x[0]), 2 * x[1]],
        {"theta": [1e-12, 1.0], "scale": 1.0},
    ),
    "tiny inputs that matter": (
        0,
        "smooth",
        lambda x: starting(1e9 * x),
        lambda x: [1e9 * np.cos(1e9 * x[0]), 2e18 * x[1]],
        {"theta": [1e-10, 1e-9]},
    ),
    "a gradient that mixes its batch": (
        1,
        "nondeterministic",
        lambda x: np.sin(x[0]) * x[1],
        lambda x: np.stack([np.cos(x[0]) * x[1], np.sin(x[0]).mean() + 0.0 * x[0]]),
        {"theta": [0.4, 0.9], "batch": "columns"},
    ),
    "0 beside a small slope": (1, "disconnected", residue(1e-6), by_size(0.0), {}),
    "few calls beside a kink": (
        3,
        "unsettled",
        lambda x: float(5.0 * max(x[0] - 0.3 - 1e-9, 0.0) + np.sin(x[1])),
        lambda x: [5.0, np.cos(x[1])],
        {"theta": [0.3, 0.2], "calls": 30},
    ),
    "a small kink": (1, "kink", bent(3e-4), side(3e-4, 1.0), {"theta": [0.3, 0.9], "calls": 1500}),
    "beside a small kink": (1, "missing_term", bent(3e-4), side(3e-4, 4.0), {"theta": [0.3, 0.9], "calls": 1500}),
    "a kink": (1, "kink", kinked, lambda x: [1.0 if x[0] >= 1.0 else -1.0], {"theta": [1.0]}),
    "an expected kink": (
        0,
        "kink",
        kinked,
        lambda x: [1.0 if x[0] >= 1.0 else -1.0],
        {"theta": [1.0], "expect": "kink"},
    ),
    "a sign keeps the norm": (
        1,
        "wrong_factor",
        lambda x: float(np.sin(x[0]) + x[1] ** 2),
        lambda x: [-np.cos(x[0]), -2 * x[1]],
        {},
    ),
    "small treads": (1, "staircase", steps_of, lambda x: [np.cos(x[0]) * x[1], np.sin(x[0])], {"theta": [0.5, 0.7]}),
    "constant between jumps": (
        1,
        "staircase",
        lambda x: np.floor(20 * x[0]) / 20,
        None,
        {"theta": [1.01], "sigma": 0.1},
    ),
    "a straight-through rounding": (
        1,
        "staircase",
        lambda x: float(np.round(8.0 * x[0]) / 8.0),
        lambda x: [1.0],
        {"theta": [0.3], "sigma": [0.01, 0.5], "calls": 8000},
    ),
    "a straight-through rounding beside a smooth input": (
        1,
        "staircase",
        lambda x: float(rounded(x[0]) ** 2 + x[1] ** 2 * rounded(x[0])),
        lambda x: [2 * rounded(x[0]) + x[1] ** 2, 2 * x[1] * rounded(x[0])],
        {"theta": [0.62, 0.8]},
    ),
    "jumps off the grid of steps": (
        1,
        "",
        lambda x: x[0] + np.floor(1e4 * x[0]) / 1e4,
        lambda x: [1.0],
        {"theta": [1.00005]},
    ),
    "a rounded latent": (
        1,
        "staircase",
        latent,
        lambda x, w: [0.0],
        {"theta": [0.3], "sigma": 0.3, "noise": 20, "calls": 8000},
    ),
    "no draw moves the cost": (
        3,
        "constant",
        lambda x: 1.0 * (x[0] > 30),
        lambda x: [0.0],
        {"theta": [0.0], "sigma": 0.1},
    ),
    "an estimator and few calls": (3, "unmeasured", square, score(1.0), {**SOFT, "calls": 600}),
    "an estimator": (0, "estimator", square, score(1.0), {**SOFT, "calls": 20_000}),
    "twice an estimator": (1, "biased", square, score(2.0), {**SOFT, "calls": 20_000}),
    "a multiple of each slope": (
        0,
        "",
        thrown,
        lambda x, w: [thrown(x, w) / x[0] * (1.0 + x[0] * (1.0 - chance(x)))],
        {**SOFT, "noise": 2, "calls": 20_000},
    ),
    "a derivative without a number at some draws": (
        1,
        "nan_gradient",
        lambda x, w: float(x[0] ** 2 + x[0] * w[0]),
        lambda x, w: lost(2.0 * x[0] + w[0], w),
        SOFT,
    ),
    "without a number in the tails": (
        1,
        "nan_gradient",
        wide,
        lambda x: [2 * x[0] if x[0] < 1.35 else math.nan],
        treads,
    ),
    "a cost that ends in the tails": (
        0,
        "smooth",
        lambda x: float(np.sqrt(1.35 - x[0])),
        lambda x: -0.5 / np.sqrt(1.35 - x),
        treads,
    ),
    "noise hides a mean": (
        3,
        "",
        lambda x: float(np.sin(1e4 * x[0]) + 1e-3 * x[0]),
        lambda x: 1e4 * np.cos(1e4 * x) + 1e-3,
        {"theta": [0.36], "sigma": 0.5},
    ),
    "a steep smooth cost": (
        3,
        "spread",
        steep,
        lambda x: (1.0 - np.tanh((x - 1.003) / 1e-4) ** 2) / 1e-4 + 0.1,
        {"theta": [1.0], "sigma": 0.01, "calls": 6000},
    ),
}
"""Status, cause where it is known, cost, gradient and settings."""


@pytest.mark.parametrize("name", CASES)
def test_a_gradient_gets_its_verdict(name):
    status, cause, cost, grad, settings = CASES[name]
    report = bench.examine(cost, grad=grad, progress=False, **{"theta": START, "calls": 3000, **settings})
    assert report.status == status, str(report)
    assert cause in ("", report.cause), str(report)


def test_a_refined_cost_excuses_no_block_that_no_component_shows():
    """The 16 components that were compared are right, and 16 of 400 inputs are wrong by half."""
    random = np.random.default_rng(0)
    weights, theta = random.uniform(1.0, 2.0, 400), random.uniform(0.5, 1.5, 400)

    def refined(x):
        return float(weights @ x**2)

    def gradient(x):
        return 2.0 * weights * x * np.where(np.arange(400) // 8 == 25, 1.5, 1.0)

    report = bench.examine(
        lambda x: refined(x) + 2e-4 * np.sin(20.0 * x).sum(), theta, grad=gradient, refined=refined, calls=6000
    )
    assert report.derivative == "wrong"
