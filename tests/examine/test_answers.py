"""What the report says: answers rest on what was measured, and commands can be pasted."""

import math
import re
from functools import partial

import numpy as np
import pytest

import bench
from bench import cli

examine = partial(bench.examine, progress=False, calls=3000)
THETA = [1.0, 2.0]


def cost(x):
    return float(x[0] ** 2 + 3 * x[1])


def gradient(x, factor=1.0):
    return [2 * factor * x[0], 3.0]


def wrong(x):
    return gradient(x, 1.5)


def with_steps(x, steps=5):
    return cost(x)


def wrong_with_steps(x, steps=5):
    return wrong(x)


@pytest.mark.parametrize("settings", [{}, {"sigma": 0.1, "calls": 200}])
def test_noise_that_was_not_measured_gets_no_answer(settings):
    report = examine(cost, THETA, grad=wrong, **settings)
    assert (report.derivative, report.use) == ("wrong", "not measured")
    assert "is wrong" not in report.noise_answer


def test_the_bias_of_a_wrong_gradient_is_not_blamed_on_a_jump():
    report = examine(cost, THETA, grad=wrong, sigma=0.1)
    assert report.noise_cause == "biased"
    assert "jump" not in report.noise_answer


@pytest.mark.parametrize("is_raised", [True, False])
@pytest.mark.parametrize(("edge", "status", "cause"), [(1e-3, 0, "smooth"), (1e-6, 3, "nonfinite")])
def test_a_cost_that_fails_near_theta_is_reported(edge, status, cause, is_raised):
    def failing(x):
        if x[0] > 1.0 + edge:
            if is_raised:
                raise ValueError("the solver diverged")
            return math.nan
        return cost(x)

    report = examine(failing, THETA, grad=gradient)
    assert (report.status, report.cause) == (status, cause)
    said = report.problems if status else report.warnings
    assert any("nearest at theta[0] + " in text for text in said)


def test_a_cost_without_a_value_at_theta_blames_no_input():
    report = examine(lambda x: math.nan, THETA, grad=gradient)
    assert report.status == 3
    assert "the cost at theta itself is NaN" in report.conclusion
    assert "theta[0]" not in report.conclusion


@pytest.mark.parametrize(("name", "has_steps"), [("cost", False), ("with_steps", True)])
def test_proposed_commands_are_lines_of_their_own(name, has_steps, capsys):
    place = f"{__file__}:{name}"
    slope = "wrong_with_steps" if has_steps else "wrong"
    cli.main(["examine", place, "theta=1,2", f"grad={slope}", "calls=3000", "--quiet"])
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if "python -m bench" in line]
    assert all(line.startswith("python -m bench examine ") for line in lines)
    assert any(line.endswith("horizons=1,2,5") for line in lines) == has_steps


def test_sigma_by_input_is_a_range():
    report = examine(lambda x: float(x @ x), np.ones(4), grad=lambda x: 2 * x, sigma=[[0.02, 0.02, 20.0, 0.05]])
    assert "Under noise of sigma 0.020 to 20:" in report.noise_answer
    assert "sigma 20" not in str(report)


def test_an_error_within_the_tolerance_is_in_the_headline():
    report = examine(cost, THETA, grad=partial(gradient, factor=1.04), tolerance=0.1)
    assert report.status == 0
    assert report.conclusion.startswith("Derivative: right within the tolerance, off by up to 4.0%.")


def test_the_headline_has_the_numbers_of_its_own_cause():
    def slope(x):
        return np.array(
            [
                2 * np.cos(x[0]) + np.cos(x[1]) - 0.01 * x[0] ** 2,
                2 * x[1] - x[0] * np.sin(x[1]) - 0.3 * np.cos(3 * x[0]),
            ]
        )

    report = examine(
        lambda x: float(2 * np.sin(x[0]) + np.cos(x[1]) * x[0] + x[1] ** 2), np.array([0.7, 0.1]), grad=slope
    )
    assert list(report.frame["verdict"][:2]) == ["missing_term", "wrong_adjoint"]
    assert report.conclusion.startswith(f"Derivative: WRONG. {report.frame['verdict'][0]}:")
    assert f"theta[0]: program {report.frame['program'][0]:.6g}" in report.conclusion
    assert "and 1 more" in report.conclusion


def test_a_problem_is_said_of_the_sigmas_that_show_it():
    report = examine(lambda x: float(x @ x + (x[0] > 1.2)), np.ones(2), grad=lambda x: 2 * x, sigma=[0.01, 0.2])
    assert report.noise_answer.startswith("Under noise of sigma 0.20: NOT usable. biased")


def test_an_expected_cause_that_excuses_nothing_is_said_plainly():
    report = examine(cost, THETA, grad=wrong, expect="wrong_factor")
    assert report.status == 1
    assert "expect=wrong_factor does not excuse a wrong gradient" in report.warnings


def test_a_cost_without_a_gradient_gets_what_smoothing_gives_under_noise():
    report = examine(lambda x: float(x[0] ** 2 + (x[0] > 1.05)), [1.0], sigma=0.1, calls=6000)
    assert report.noise_answer.startswith("Under noise, by smoothing: sigma 0.10: |grad J| = 5.")
    assert "1 jump of up to 1.0 within 4 sigma" in report.noise_answer


def test_a_few_calls_in_single_precision_reach_lines_and_noise():
    def single(x):
        x = np.asarray(x, np.float32)
        return np.float32(np.sin(x[0]) * x[1] + np.float32(0.3) * x[2] ** 2)

    def slope(x):
        return np.array([np.cos(x[0]) * x[1], np.sin(x[0]), 0.6 * x[2]], np.float32)

    report = examine(single, [0.4, 0.7, 1.2], grad=slope, sigma=0.05, calls=1500)
    assert report.lines
    assert report.use == "usable", str(report)


@pytest.mark.parametrize("pairs", [128, 4096])
def test_no_bound_on_the_bias_is_tighter_than_its_draws_support(pairs):
    """A linear cost: an event that none of 2 n draws meets is as likely as 3 in them, and moves the cost by 8 sigma."""
    report = examine(lambda x: float(x[0]), [1.0], grad=lambda x: [1.0], sigma=0.1, calls=4 * pairs + 2000)
    bound = float(re.search(r"below ([\d.]+)%", report.noise_answer)[1])
    assert bound > 100.0 * 3.0 / (2.0 * report.smoothed[0].pairs), str(report)


def test_a_kink_is_no_wrong_derivative():
    report = examine(lambda x: float(abs(x[0] - 1.0)), [1.0], grad=lambda x: [1.0 if x[0] >= 1.0 else -1.0])
    assert (report.status, report.derivative, report.cause) == (1, "undefined", "kink")
    assert report.conclusion.startswith("Derivative: UNDEFINED. kink")


def test_a_straight_through_rounding_is_a_staircase():
    report = examine(
        lambda x: float(np.round(8.0 * x[0]) / 8.0), [0.3], grad=lambda x: [1.0], sigma=[0.01, 0.5], calls=20_000
    )
    assert (report.status, report.cause) == (1, "staircase"), str(report)
    assert "usable at sigma 0.50" in report.noise_answer


NARROW = 0.02
"""Standard deviation of the noise on the input of a smoothed square."""


def smoothed_square(x, w):
    return float((x[0] + NARROW * w[0]) ** 2)


@pytest.mark.parametrize(
    ("factor", "calls", "cause"), [(1.0, 600, "unmeasured"), (1.0, 20_000, "estimator"), (2.0, 20_000, "biased")]
)
def test_an_estimator_without_a_baseline_is_judged_by_its_mean(factor, calls, cause):
    """Its draws are nearly linear in w, as the slopes are."""
    report = examine(
        smoothed_square, [1.0], grad=lambda x, w: [factor * smoothed_square(x, w) * w[0] / NARROW], noise=1, calls=calls
    )
    assert report.cause == cause, str(report)
    if factor > 1.0:
        assert "off by 100%" in report.conclusion


def test_an_estimator_that_is_a_multiple_of_each_slope_is_not_wrong():
    """J = x p(x) with a Bernoulli factor: each draw's gradient is its slope times 1 + x (1 - p)."""

    def chance(x):
        return 1.0 / (1.0 + math.exp(-x[0]))

    def cost(x, w):
        return float(x[0] * math.exp(0.3 * w[1]) * (0.5 * math.erfc(-w[0] / math.sqrt(2.0)) < chance(x)))

    def score(x, w):
        return [cost(x, w) / x[0] * (1.0 + x[0] * (1.0 - chance(x)))]

    for calls in (500, 20_000):
        report = examine(cost, [1.0], grad=score, noise=2, calls=calls)
        assert report.status == (3 if calls == 500 else 0), str(report)


@pytest.mark.parametrize(("change", "cause"), [(lambda g: -g, "wrong_factor"), (lambda g: g * [1.0003, 1.0005], "")])
def test_a_cheap_explanation_replaces_no_better_one(change, cause):
    """A changed sign keeps the norm, and sorting hides a small error."""
    report = examine(
        lambda x: float(np.sin(x[0]) + x[1] ** 2), [1.0, 0.1], grad=lambda x: change(np.array([np.cos(x[0]), 2 * x[1]]))
    )
    assert report.status == 1
    assert cause in ("", report.cause), str(report)
    assert "in another" not in report.conclusion


FIRST_LOST = 2.2
"""The draw from which on a gradient is not a number: 1 in 72."""


def lost(value, w):
    return [value if w[0] < FIRST_LOST else math.nan]


@pytest.mark.parametrize(
    ("cost", "grad"),
    [
        (smoothed_square, lambda x, w: lost(smoothed_square(x, w) * w[0] / NARROW, w)),
        (lambda x, w: float(x[0] ** 2 + x[0] * w[0]), lambda x, w: lost(2.0 * x[0] + w[0], w)),
    ],
    ids=["estimator", "derivative"],
)
def test_a_gradient_that_is_not_a_number_at_some_draws_is_a_fault(cost, grad):
    report = examine(cost, [1.0], grad=grad, noise=1, calls=20_000)
    assert (report.status, report.cause) == (1, "nan_gradient"), str(report)


def test_a_gradient_that_is_not_a_number_in_the_tails_of_the_noise_is_a_fault():
    """Beyond 3.5 standard deviations, which few draws reach."""
    report = examine(
        lambda x: float(x[0] ** 2), [1.0], grad=lambda x: [2 * x[0] if x[0] < 1.35 else math.nan], sigma=0.1
    )
    assert (report.status, report.cause, report.use) == (1, "nan_gradient", "NOT usable"), str(report)
    whole = examine(
        lambda x: float(np.sqrt(1.35 - x[0])), [1.0], grad=lambda x: [-0.5 / np.sqrt(1.35 - x[0])], sigma=0.1
    )
    assert whole.cause != "nan_gradient", str(whole)
