"""The check of a gradient: each planted fault gets the name of its cause, and right gradients of hard costs get none."""

import numpy as np
import pytest

from bench.gradient import EPS, TRUSTED, VERDICTS, Options, check, roughness
from bench.gradient.check import scales

THETA = np.array([0.3, 1.2, -0.7])
UNIT = float(np.finfo(np.float64).eps)
FAULTS_OF_A_NUMBER = ("disconnected", "wrong_factor", "missing_term", "wrong_adjoint")
EXACT = 1e-7
"""Relative error allowed to a difference of a cost without noise: its own tolerance is ten times less."""


def cost(x):
    return (np.sin(x) + 0.1 * x**2).sum(axis=0) + x[0] * x[1]


def gradient(x):
    return np.cos(x) + 0.2 * x + np.array([x[1], x[0], 0.0 * x[0]])


def stairs(x, tread):
    return (np.floor(x / tread) * tread * 0.168).sum(axis=0)


def single(x):
    return x.astype(np.float32).astype(np.float64)


def first(value):
    return np.array([value, 0.0, 0.0])


def clipped(x):
    return np.stack([x[0], x[1], np.maximum(x[2], -0.695)])


def noisy(function, size):
    generator = np.random.default_rng(1)
    return lambda x: function(x) + size * generator.standard_normal(np.shape(function(x)))


FAULTS = {
    "nan": ("nan_gradient", cost, lambda x: np.nan * x),
    "inf in one component": ("nan_gradient", cost, lambda x: gradient(x) + first(np.inf)),
    "noise in the gradient": ("nondeterministic", cost, noisy(gradient, 1e-7)),
    "noise in the cost": ("nondeterministic", noisy(cost, 1e-12), gradient),
    "cost that depends on its place in a batch": (
        "nondeterministic",
        lambda x: cost(x) + 1e-9 * np.arange(x.shape[1]),
        gradient,
    ),
    "kept from the first theta": ("stale_gradient", cost, lambda x: gradient(THETA)),
    "cast to int": ("staircase", lambda x: stairs(x, 1e-6), lambda x: 0.0 * x),
    "cast to int of a term": ("staircase", lambda x: cost(x) + stairs(x, 1e-6), gradient),
    "wide treads": ("staircase", lambda x: cost(x) + stairs(x, 1e-4), gradient),
    "narrow treads": ("staircase", lambda x: cost(x) + stairs(x, 1e-8), gradient),
    "theta in single precision": ("precision", lambda x: cost(single(x)), gradient),
    "cost in single precision": ("precision", lambda x: single(cost(x)), gradient),
    "term in single precision": (
        "precision",
        lambda x: cost(x) + np.exp(single(x)).sum(axis=0),
        lambda x: gradient(x) + np.exp(x),
    ),
    "stopped": ("disconnected", cost, lambda x: 0.0 * x),
    "one component stopped": ("disconnected", cost, lambda x: gradient(x) * [0.0, 1.0, 1.0]),
    "half": ("wrong_factor", cost, lambda x: 0.5 * gradient(x)),
    "one part in a thousand": ("wrong_factor", cost, lambda x: 1.001 * gradient(x)),
    "sign": ("wrong_factor", cost, lambda x: -gradient(x)),
    "sign of one component": ("wrong_factor", cost, lambda x: gradient(x) * [-1.0, 1.0, 1.0]),
    "half beside small jumps": (
        "wrong_factor",
        lambda x: cost(x) + 1e-3 * stairs(x, 1e-6),
        lambda x: 0.5 * gradient(x),
    ),
    "coupling left out": ("missing_term", cost, lambda x: np.cos(x) + 0.2 * x),
    "term of one component left out": ("missing_term", cost, lambda x: gradient(x) - first(np.cos(x[0]))),
    "large term too many in one component": (
        "missing_term",
        cost,
        lambda x: gradient(x) + first(8.0 * np.cos(9.0 * x[0])),
    ),
    "little left out": ("missing_term", cost, lambda x: gradient(x) - 0.004 * np.cos(x) * [1.0, 0.7, 0.9]),
    "term that acts only here": (
        "missing_term",
        lambda x: cost(x) - 40.0 * np.maximum(0.6 - x[0], 0.0) ** 2 * (x[1] + 3.0 * x[2]),
        gradient,
    ),
    "factor that hardly changes": ("missing_term", cost, lambda x: gradient(x) * (0.5 + 2e-3 * x[1])),
    "wrong beside theta": ("missing_term", cost, lambda x: gradient(x) + 0.3 * (x - THETA)),
    "components in another order": ("wrong_adjoint", cost, lambda x: gradient(x)[[1, 2, 0]] * [-1.0, 3.0, 4.0]),
    "jump": ("jump", lambda x: cost(x) + 0.1 * (x[0] > 0.3), gradient),
    "small jump": ("jump", lambda x: cost(x) + 2.5e-8 * (x[0] > 0.3), gradient),
    "lone point": ("jump", lambda x: cost(x) + 1e-3 * (x[0] != 0.3), gradient),
    "kink": ("kink", lambda x: cost(x) + np.abs(x[0] - 0.3), lambda x: gradient(x) + first(np.sign(x[0] - 0.3))),
    "even kink": ("kink", lambda x: np.abs(x - THETA[:, None]).sum(axis=0), lambda x: np.sign(x - THETA)),
    "beyond both slopes of a kink": (
        "wrong_adjoint",
        lambda x: np.abs(x[0] - 0.3) + x[1:].sum(axis=0),
        lambda x: np.array([1.5, 1.0, 1.0]),
    ),
    "clipped": ("saturated", lambda x: cost(clipped(x)), lambda x: gradient(clipped(x)) * [1.0, 1.0, x[2] > -0.695]),
    "cost that is not a number": ("nonfinite", lambda x: cost(x) * np.nan, gradient),
    "cost without a scale": ("unsettled", lambda x: np.modf(1e4 * np.sin(1e14 * x))[0].sum(axis=0), gradient),
}
"""Name of a fault to the cause that it must get, and the cost and gradient that have it."""


@pytest.mark.parametrize("name", FAULTS)
def test_planted_fault_is_named_by_its_cause(name):
    cause, planted, program = FAULTS[name]
    found = check(planted, program, THETA)
    assert found.cause == cause, found.sentence()
    assert found.trusted == (cause in TRUSTED)


def test_a_factor_is_one_though_rounding_spoils_its_ratios_and_a_few_roundings_are_no_staircase():
    """Beside 1e10 a ratio is known to a thousandth only; beside 1e6 treads of 2.5e-9 are ten roundings high."""
    assert check(lambda x: 1e10 + cost(x), lambda x: 0.5 * gradient(x), THETA).cause == "wrong_factor"
    stepped = check(lambda x: 1e6 + np.floor(cost(x) / 2.5e-9) * 2.5e-9, lambda x: 0.5 * gradient(x), THETA)
    assert stepped.cause == "wrong_factor", stepped.sentence()


def test_what_the_last_digits_of_theta_change_in_a_gradient_is_no_fault():
    """As on an amplifying rollout: the gradient is asked for at theta four roundings away, to see how much that is."""

    amplified = check(cost, lambda x: gradient(x) * (1.0 + 2e-5 * np.sin(3e16 * x)), THETA, Options(draws=0))
    errors = [abs(part.ratio - 1.0) for part in amplified.components]
    assert amplified.trusted
    steady = check(cost, lambda x: gradient(x) * (1.0 + max(errors)), THETA, Options(draws=0))
    assert not steady.trusted


def test_gradient_beside_a_minimum_is_wrong_though_no_two_differences_agree_there():
    """They are rounding only, and yet all of them are far from the gradient."""
    found = check(lambda x: np.cos(x[0]), lambda x: 1e-3 - np.sin(x), np.zeros(1))
    assert [part.verdict for part in found.components] == ["wrong_adjoint"]
    assert check(lambda x: np.cos(x[0]), lambda x: -np.sin(x), np.zeros(1)).trusted


def test_right_gradient_is_smooth_and_each_component_has_its_numbers():
    found = check(cost, gradient, THETA)
    assert found.cause == "smooth"
    assert [part.component for part in found.components] == [0, 1, 2]
    right = gradient(THETA)
    for part, value in zip(found.components, right, strict=True):
        assert part.program == value
        assert abs(part.difference - value) <= part.uncertainty <= EXACT * abs(value)
        assert abs(part.ratio - 1.0) <= EXACT
        assert part.step in THETA[part.component].__abs__() * EPS
    assert found.order == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("factor", [0.5, 1.001, -1.0])
def test_taylor_remainder_of_a_wrong_gradient_is_of_first_order(factor):
    assert check(cost, lambda x: factor * gradient(x), THETA).order == pytest.approx(1.0, abs=0.05)


def test_fault_of_one_component_is_that_components():
    found = check(cost, lambda x: gradient(x) * [1.0, 0.5, 1.0], THETA)
    assert [part.verdict for part in found.components] == ["smooth", "wrong_factor", "smooth"]
    assert "component 1" in found.sentence()
    assert "ratio 0.5" in found.sentence()


def test_many_components_are_checked_by_the_largest_the_smallest_and_random_directions():
    weights = np.arange(1.0, 41.0)

    def square(x):
        return (weights[:, None] * x**2).sum(axis=0)

    found = check(square, lambda x: 2.0 * weights * x, np.ones(40))
    assert [part.component for part in found.components] == [*range(8), *range(32, 40)]
    assert found.cause == "smooth"
    unseen = check(square, lambda x: 2.0 * weights * x * np.where(np.arange(40) == 20, 0.9, 1.0), np.ones(40))
    assert not unseen.trusted


def test_inputs_of_very_different_size_have_steps_of_their_own():
    theta = np.array([1e6, 1e-6, 0.0])

    def mixed(x):
        return np.sin(x[0] / 1e6) + np.exp(x[1] * 1e6) + np.exp(x[2])

    def slopes(x):
        return np.array([np.cos(x[0] / 1e6) / 1e6, 1e6 * np.exp(x[1] * 1e6), np.exp(x[2])])

    found = check(mixed, slopes, theta)
    assert [part.verdict for part in found.components] == ["smooth"] * 3
    assert [part.sample.scale for part in found.components] == [1e6, 1e-6, 1.0]
    assert np.array_equal(scales(theta), [1e6, 1e-6, 1.0])


@pytest.mark.parametrize("size", [1e200, 1e300])
def test_a_square_that_overflows_blames_no_gradient_and_hides_no_fault(size):
    assert check(lambda x: size * cost(x), lambda x: size * gradient(x), THETA).trusted
    assert check(lambda x: size * cost(x), lambda x: 1.1 * size * gradient(x), THETA).cause == "wrong_factor"


def test_cost_that_has_decayed_below_the_smallest_number_is_no_fault():
    found = check(lambda x: 5e-320 * x[0] ** 2, lambda x: 1e-319 * x, np.array([1.0]))
    assert found.trusted, found.sentence()


@pytest.mark.parametrize("slope", [5e-6, 1e-5, 2e-5])
def test_amplified_rounding_on_a_slope_is_no_staircase(slope):
    """Rounding a thousandth of the increments in size: some stand out of the others, by a little."""
    steps = np.arange(roughness.SCAN)
    for seed in range(50):
        noise = 3e-9 * np.random.default_rng(seed).standard_normal(steps.size)
        assert not roughness.is_staircase(slope * steps + noise, 1e-15)
    assert roughness.is_staircase(slope * steps + 1e-7 * (steps // 7), 1e-15)
    assert roughness.is_staircase(slope * steps + 1e-7 * np.floor(steps / 4.3) + 1e-9 * np.sin(steps), 1e-15)


def test_noise_of_the_cost_is_measured():
    rough = check(lambda x: cost(x) + 1e-7 * np.sin(1e13 * x).sum(axis=0), gradient, THETA)
    assert rough.cause == "rounding"
    assert 1e-8 < rough.noise < 1e-6
    assert check(cost, gradient, THETA).noise < 4 * UNIT


def test_single_precision_that_is_declared_is_no_fault():
    found = check(lambda x: cost(single(x)), gradient, THETA, Options(unit=float(np.finfo(np.float32).eps)))
    assert found.trusted, found.sentence()


def test_complex_numbers_and_wrong_shapes_are_errors():
    with pytest.raises(TypeError, match="gradient is complex"):
        check(cost, lambda x: gradient(x) + 0j, THETA)
    with pytest.raises(TypeError, match="cost is complex"):
        check(lambda x: cost(x) + 0j, gradient, THETA)
    with pytest.raises(ValueError, match=r"gradient has shape \(3, 1\)"):
        check(cost, lambda x: gradient(x)[:, None], THETA)
    with pytest.raises(ValueError, match=r"cost has shape \(1, 255\)"):
        check(lambda x: cost(x)[None], gradient, THETA)


def test_cost_is_judged_without_a_gradient():
    assert check(cost, None, THETA).cause == "smooth"
    assert check(FAULTS["jump"][1], None, THETA).cause == "jump"
    assert check(FAULTS["wide treads"][1], None, THETA).cause == "staircase"


def test_every_verdict_is_trusted_or_not():
    assert VERDICTS[-len(TRUSTED) :] == TRUSTED


# -------------------------------------------------------------------------------------------- amplifying rollouts


def rollout(x, steps, tangent=None):
    """The standard map (Chirikov 1979) from ``x (2, ...)``: an amplifying rollout; with its tangent, if asked for."""
    q, p = x
    for _ in range(steps):
        if tangent is not None:
            dp = tangent[1] + 1.5 * np.cos(q) * tangent[0]
            tangent = np.stack([tangent[0] + dp, dp])
        p = p + 1.5 * np.sin(q)
        q = q + p
    return (q, p) if tangent is None else tangent


def chaos(steps):
    def final(x):
        q, p = rollout(x, steps)
        return np.cos(q) + 0.1 * np.sin(p)

    def slope(x):
        q, p = rollout(x, steps)
        d = rollout(np.repeat(x[:, None], 2, axis=1), steps, np.eye(2))
        return -np.sin(q) * d[0] + 0.1 * np.cos(p) * d[1]

    return final, slope


@pytest.mark.parametrize("steps", [1, 10, 30, 60, 100])
@pytest.mark.parametrize("seed", range(2))
def test_right_gradient_of_an_amplifying_rollout_is_no_fault(steps, seed):
    """Differences over wide steps agree with each other on nothing, which must not be taken for the derivative."""
    theta = np.random.default_rng(seed).uniform(0.5, 3.0, 2)
    found = check(*chaos(steps), theta)
    assert found.cause in (*TRUSTED, "unsettled"), found.sentence()
    if steps <= 10:
        assert found.trusted, found.sentence()


@pytest.mark.parametrize("factor", [0.0, 0.5, -1.0])
def test_fault_of_an_amplifying_rollout_is_seen(factor):
    final, slope = chaos(10)
    assert not check(final, lambda x: factor * slope(x), np.array([1.1, 2.3])).trusted


@pytest.mark.parametrize("offset", [0.0, 0.07, -0.3])
@pytest.mark.parametrize("curvature", [0.0, 1.0, 100.0])
def test_a_gradient_that_is_wrong_at_theta_alone_is_wrong(offset, curvature):
    """A node of a table, a tie, a state of exactly 0: the cost has one slope, and the program's rule another one there."""

    def ramp(x):
        return 0.25 * x[0] + curvature * (x[0] - 1.0) ** 2

    def slope(x):
        return np.array([offset if x[0] == 1.0 else 0.25 + 2.0 * curvature * (x[0] - 1.0)])

    assert check(ramp, slope, np.array([1.0])).cause in FAULTS_OF_A_NUMBER
    assert check(ramp, lambda x: np.array([0.25 + 2.0 * curvature * (x[0] - 1.0)]), np.array([1.0])).trusted
