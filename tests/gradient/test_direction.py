"""The judgement on one direction: samples made by hand at the edge of each threshold, on either side of it."""

import numpy as np
import pytest

from bench.gradient import EPS, TRUSTED, Sample, check, judge, roughness
from bench.gradient.causes import Ratio, causes_of_ratios

SLOPE = 2.0
WIDE = np.logspace(-2, -5, 7)
NARROW = np.logspace(-7, -10, 7)


def of_differences(differences, step, derivative, **given):
    """A sample whose central differences are these; its left and right sides are alike."""
    rise = np.asarray(differences) * step
    return Sample(step, 1.0 - rise, 1.0, 1.0 + rise, derivative, np.zeros(step.size, bool), **given)


@pytest.mark.parametrize(("spreads", "trusted"), [(5.0, True), (30.0, False)])
def test_a_derivative_is_right_within_ten_times_what_neighbours_disagree_by(spreads, trusted):
    differences = SLOPE + WIDE**2
    spread = abs(differences[-2] - differences[-1])
    found = judge(of_differences(differences, WIDE, differences[-1] + spreads * spread, unit=1e-36, noise=0.0))
    assert (found.verdict in TRUSTED) == trusted, found.verdict


@pytest.mark.parametrize(("ripple", "trusted"), [(0.02, True), (0.3, False)])
def test_differences_that_agree_only_to_their_own_size_show_nothing(ripple, trusted):
    differences = SLOPE * (1.0 + ripple * (-1.0) ** np.arange(EPS.size))
    found = judge(of_differences(differences, EPS, SLOPE, unit=1e-36, noise=0.0))
    assert found.verdict in (TRUSTED if trusted else ("unsettled",))


@pytest.mark.parametrize("factor", [1.0, 0.5, 0.0])
def test_differences_that_scatter_do_not_pass_half_of_the_derivative(factor):
    differences = SLOPE * (1.0 + 0.045 * (-1.0) ** np.arange(EPS.size))
    found = judge(of_differences(differences, EPS, factor * SLOPE, unit=1e-36, noise=0.0))
    assert found.verdict in (TRUSTED if factor == 1.0 else ("unsettled", "disconnected"))


@pytest.mark.parametrize(("finite", "told"), [(7, True), (6, False)])
def test_seven_steps_with_numbers_are_enough(finite, told):
    differences = np.full(EPS.size, SLOPE)
    differences[: EPS.size - finite] = np.inf
    found = judge(of_differences(differences, EPS, SLOPE, unit=1e-36, noise=0.0))
    assert found.verdict == ("smooth" if told else "nonfinite")


@pytest.mark.parametrize("noise", [0.0, 1e-15])
def test_an_error_of_a_ten_thousandth_is_seen_where_only_small_steps_are_left(noise):
    """Rounding explains some 1e-7 of such differences, and not an error of 1e-4."""
    differences = np.full(NARROW.size, SLOPE)
    assert judge(of_differences(differences, NARROW, SLOPE, noise=noise)).verdict in TRUSTED
    assert judge(of_differences(differences, NARROW, SLOPE * 1.0001, noise=noise)).verdict == "wrong_adjoint"


def test_measured_noise_explains_eight_of_its_standard_deviations_and_no_more():
    size, generator = 1e-12, np.random.default_rng(0)
    for _ in range(200):
        below, at, above = size * generator.standard_normal((3, NARROW.size))
        given = NARROW, 1.0 - SLOPE * NARROW + below, 1.0 + at[0], 1.0 + SLOPE * NARROW + above
        crossing = np.zeros(NARROW.size, bool)
        right = judge(Sample(*given, SLOPE, crossing, noise=size))
        assert right.verdict in (*TRUSTED, "unsettled"), right
        wrong = judge(Sample(*given, SLOPE * 1.002, crossing, noise=size))
        assert wrong.verdict == "wrong_adjoint", wrong


def test_a_slope_that_changes_over_wide_steps_is_nonlinear():
    assert judge(of_differences(SLOPE * (1.0 + (EPS / EPS[0]) ** 2), EPS, SLOPE)).verdict == "nonlinear"


def test_wide_differences_that_smaller_steps_contradict_are_not_believed():
    """They agree with each other to the last digit, on nothing; the smaller ones agree to six digits, on the slope."""
    differences = np.r_[np.full(6, 1e-3), 0.3, SLOPE + 1e-6 * (-1.0) ** np.arange(10)]
    found = judge(of_differences(differences, EPS, SLOPE, unit=1e-36, noise=0.0))
    assert found.verdict == "rounding"
    assert found.difference == pytest.approx(SLOPE, rel=1e-5)


@pytest.mark.parametrize(("steps", "verdict"), [(3, "unsettled"), (6, "jump")])
def test_a_jump_is_the_same_over_five_of_the_smallest_steps(steps, verdict):
    side = SLOPE * EPS
    side[-steps:] += 1e-3
    sample = Sample(EPS, 1.0 - SLOPE * EPS, 1.0, 1.0 + side, SLOPE, np.zeros(EPS.size, bool), noise=1e-16)
    assert judge(sample).verdict == verdict


PARTLY, BEYOND = [0.5, 0.7, 0.9, 1.2], [-3.0, 5.0, 2.5, -0.2]
"""Ratios of a part of the derivative, and of none."""
NEARLY, NEAR_ONE = [0.5, 0.50005, 0.49995, 0.50005], [1.001, 1.001001, 1.000999, 1.001001]


@pytest.mark.parametrize(
    ("values", "error", "given", "cause"),
    [
        (PARTLY, 1e-9, {}, "missing_term"),
        (BEYOND, 1e-9, {}, "wrong_adjoint"),
        (BEYOND, 1e-9, {"some_right": True}, "missing_term"),
        # ratios may differ by ten times their errors
        ([0.5] * 4, 1e-9, {}, "wrong_factor"),
        (NEARLY, 1e-5, {}, "wrong_factor"),
        (NEARLY, 1e-6, {}, "missing_term"),
        # and by the program's rounding, a hundred-thousandth of their size or of their distance from 1
        ([0.5, 0.500003, 0.499997, 0.5], 1e-13, {}, "wrong_factor"),
        ([0.5, 0.50003, 0.49997, 0.5], 1e-13, {}, "missing_term"),
        (NEAR_ONE, 1e-13, {}, "missing_term"),
        (NEAR_ONE, 3e-7, {}, "wrong_factor"),
        # and by no more than a thousandth, however little is known
        ([0.5, 0.5001, 0.5002, 0.4999], 1e-4, {}, "wrong_factor"),
        ([0.5, 0.505, 0.495, 0.505], 1e-2, {}, "missing_term"),
        # one of five may be spoilt, and two may not
        ([0.5] * 4 + [0.9], 1e-9, {}, "wrong_factor"),
        ([0.5] * 3 + [0.9, 0.7], 1e-9, {}, "missing_term"),
        ([*PARTLY, -3.0], 1e-9, {}, "missing_term"),
        ([*PARTLY[:3], -1.2, -3.0], 1e-9, {}, "wrong_adjoint"),
        ([*PARTLY[:3], -1.2, -3.0], 1e-9, {"right_elsewhere": True}, "missing_term"),
    ],
)
def test_ratios_and_their_errors_decide_the_cause(values, error, given, cause):
    ratios = {0: [Ratio(value, error) for value in values]}
    assert causes_of_ratios(ratios, [], **{"some_right": False, **given})[0] == cause


def test_one_factor_for_several_components_is_one_and_the_most_frequent_cause_is_that_of_directions():
    """Two ratios are too few to say alone, and enough together; what most components have, random directions have."""
    few = [Ratio(0.5, 1e-9)] * 2
    assert causes_of_ratios({0: few, 1: few}, [], False) == dict.fromkeys([0, 1, None], "wrong_factor")
    beyond, partly, same = ([Ratio(v, 1e-9) for v in values] for values in (BEYOND[:3], [0.1, 0.9, 0.5], [0.5] * 4))
    assert causes_of_ratios({0: same, 1: partly}, [], False) == dict.fromkeys([0, 1, None], "missing_term")
    assert causes_of_ratios({0: beyond, 1: partly, 2: partly}, [], False)[None] == "missing_term"
    assert causes_of_ratios({0: partly, 1: beyond, 2: beyond}, [], False)[None] == "wrong_adjoint"


def test_noise_is_the_standard_deviation_of_independent_normal_numbers():
    values = 3e-7 * np.random.default_rng(2).standard_normal((1, 100_000))
    smooth = np.linspace(0.0, 1.0, values.size) ** 2
    assert roughness.noise(values + smooth) == pytest.approx(3e-7, rel=0.02)


def test_what_little_a_component_may_be_off_is_by_the_largest_and_an_exact_0_is_none_of_it():
    def uneven(x):
        return x[0] ** 2 + 5e-9 * x[1] ** 2

    theta = np.ones(2)
    assert check(uneven, lambda x: np.array([2.0 * x[0], 1e-8 * x[1] + 1e-8]), theta).trusted
    assert not check(uneven, lambda x: np.array([2.0 * x[0], 1e-8 * x[1] + 1e-7]), theta).trusted
    assert check(uneven, lambda x: np.array([2.0 * x[0], 0.0]), theta).cause == "disconnected"


def test_treads_of_a_billionth_are_a_staircase():
    assert (
        check(lambda x: 1.0 + (np.floor(x / 7e-10) * 7e-10 * 0.1).sum(axis=0), lambda x: 0.0 * x, np.array([0.3])).cause
        == "staircase"
    )


def test_a_staircase_that_leads_nowhere_is_one_whatever_the_gradient():
    """Up and down again: the differences show no slope, so that a gradient of 0 says nothing of precision."""
    found = check(lambda x: 1.0 + 1e-7 * (np.floor(x[0] / 1e-6) % 2.0), lambda x: 0.0 * x, np.array([0.30000041]))
    assert found.cause == "staircase", found.sentence()
