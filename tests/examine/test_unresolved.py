"""What differences cannot see is not called right, and what they contradict is not called right because it is small."""

import numpy as np
import pytest

import bench

POINT = np.array([0.3, -0.7, 1.1])


def smooth(theta):
    return float(np.sin(theta).sum() * 2.0 + theta[0] * theta[1])


def slope(theta):
    return 2.0 * np.cos(theta) + np.array([theta[1], theta[0], 0.0])


@pytest.mark.parametrize("factor", [1.0, -1.0, 0.5, 2.0])
def test_a_cost_whose_rounding_hides_its_slope_shows_nothing(factor):
    report = bench.examine(lambda t: smooth(t) + 1e13, POINT, grad=lambda t: factor * slope(t), calls=800)
    assert (report.status, report.derivative, report.cause) == (3, "not shown", "unresolved"), str(report)


@pytest.mark.parametrize("factor", [-1.0, 2.0])
def test_a_float32_cost_far_from_zero_shows_nothing(factor):
    def cost(theta):
        return np.float32(np.float32(1e5) + np.float32(smooth(theta)))

    report = bench.examine(cost, POINT, grad=lambda t: (factor * slope(t)).astype(np.float32), calls=800)
    assert report.status != 0, str(report)
    assert report.derivative != "right"


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
def test_a_moderate_offset_hides_nothing(offset):
    report = bench.examine(lambda t: smooth(t) + offset, POINT, grad=slope, calls=800)
    assert report.status == 0, str(report)
    report = bench.examine(lambda t: smooth(t) + offset, POINT, grad=lambda t: -slope(t), calls=800)
    assert report.status == 1, str(report)


@pytest.mark.parametrize("second", [1e-4, 1e-3, -1e-6])
def test_a_small_component_that_differences_contradict_is_not_called_right(second):
    """The true second derivative is 1e-6, which differences resolve to a tenth."""

    def cost(theta):
        return 1e6 * np.sin(theta[0]) + 1e-6 * theta[1] + theta[2]

    def gradient(theta):
        return np.array([1e6 * np.cos(theta[0]), second, 1.0])

    theta = np.array([0.3, 0.7, 1.1])
    assert bench.examine(cost, theta, grad=gradient, calls=1500).status != 0
    right = bench.examine(cost, theta, grad=lambda t: np.array([1e6 * np.cos(t[0]), 1e-6, 1.0]), calls=1500)
    assert right.status == 0, str(right)


def test_a_minimum_is_resolved_by_the_slopes_around_it():
    report = bench.examine(
        lambda t: float(((t - POINT) ** 2).sum() + 3.0), POINT, grad=lambda t: 2 * (t - POINT) + 1e-17, calls=800
    )
    assert report.derivative == "right", str(report)


def test_a_gradient_of_the_call_before_is_wrong_at_few_calls():
    held = {"theta": POINT}

    def lagging(theta):
        before, held["theta"] = held["theta"], np.array(theta)
        return slope(before)

    for calls in (400, 800, 1500):
        held["theta"] = POINT
        report = bench.examine(smooth, POINT, grad=lagging, calls=calls)
        assert report.status == 1, str(report)


@pytest.mark.parametrize("given", [0.0, 5.0, 2.5])
@pytest.mark.parametrize("distance", [0.0, 1e-9])
def test_few_calls_at_a_kink_never_blame_a_slope_of_one_side(given, distance):
    def cost(theta):
        return float(5.0 * max(theta[0] - 0.3 - distance, 0.0) + np.sin(theta[1]))

    report = bench.examine(cost, np.array([0.3, 0.2]), grad=lambda t: np.array([given, np.cos(t[1])]), calls=30)
    assert report.status != 1 or report.cause == "kink", str(report)


def test_a_smoothed_gradient_that_noise_hides_is_not_decided():
    rng = np.random.default_rng(0)
    shift = rng.standard_normal(2)

    def cost(theta):
        return float(np.sin(1e4 * (theta + shift)).sum() + 1e-3 * theta.sum())

    def gradient(theta):
        return 1e4 * np.cos(1e4 * (theta + shift)) + 1e-3

    report = bench.examine(cost, np.array([0.3, 0.4]), grad=gradient, sigma=0.5, calls=5000)
    assert report.status != 0, str(report)


@pytest.mark.parametrize("bend", [0.3, 3e-4])
def test_a_small_change_of_slope_is_a_kink_at_every_number_of_steps(bend):
    """The first slope changes at theta by little, where 9 steps of a decade do not show it over three decades of noise."""

    def cost(theta):
        side = theta[0] - 0.3 + theta[1] - 0.9
        rough = 1e-14 * np.sin(1e17 * theta.sum())
        return float(0.02 * np.sin(theta[0]) + 0.1 * theta[1] ** 2 + bend * abs(side) + rough)

    theta = np.array([0.3, 0.9])
    given = np.array([0.02 * np.cos(0.3) + bend, 0.2 * 0.9 + bend])
    assert bench.examine(cost, theta, grad=lambda t: given, calls=1500).cause == "kink"
    wrong = bench.examine(cost, theta, grad=lambda t: given + 3 * bend, calls=1500)
    assert (wrong.status, wrong.cause == "kink") == (1, False), str(wrong)
