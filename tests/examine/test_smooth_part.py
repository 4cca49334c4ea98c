"""Adaptive solvers: a gradient is held to the cost's smooth part, since tiny steps show one sequence of steps only."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulators import complex_step

import bench
from bench.gradient.smooth_part import smooth_part

UNIT = float(np.finfo(np.float64).eps)


def rough(t):
    return 2.0 * np.sin(t + 0.3) + 1e-6 * np.sin(1e9 * t * (1.0 + t))


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_staircases_and_smooth_costs_have_no_rough_part(size):
    def along(t):
        return 2.0 * np.sin(t) if size == 0.0 else np.round(t / size) * size

    assert smooth_part(along, 1.0, UNIT, np.random.default_rng(0)) is None


def test_the_smooth_part_of_a_rough_cost_is_known_within_its_error():
    for seed in range(20):
        found = smooth_part(rough, 1.0, UNIT, np.random.default_rng(seed))
        assert abs(found.slope - 2.0 * np.cos(0.3)) <= found.error, seed
        assert found.error < 1e-3


@pytest.mark.parametrize("factor", [1.0, 1.3, -1.0])
def test_an_error_of_one_number_of_many_shows_through_a_rough_cost(factor):
    """Numbers that are not checked one by one move along a random direction, which tiny steps do not show either."""
    random = np.random.default_rng(0)
    theta, along = random.uniform(0.5, 1.5, (2, 30))
    factors = np.where(np.argsort(np.argsort(theta)) == 15, factor, 1.0)
    report = bench.examine(
        lambda x: float(x @ x + 1e-6 * np.sin(1e9 * (along @ x) * (1.0 + along @ x))),
        theta,
        grad=lambda x: 2.0 * factors * x,
        calls=20_000,
        progress=False,
    )
    assert report.derivative in (("wrong",) if factor != 1.0 else ("right", "not shown")), str(report)


def exact(x):
    """Return the position of a damped oscillator after 4 s; theta is stiffness, damping and first position."""
    rate, frequency = x[1] / 2, np.sqrt(x[0] - x[1] ** 2 / 4)
    return x[2] * np.exp(-4 * rate) * (np.cos(4 * frequency) + rate / frequency * np.sin(4 * frequency))


@pytest.mark.parametrize(
    ("answer", "factor", "rtol", "settings"),
    [
        ("not shown", 1.0, 1e-3, {}),
        ("right", 1.0, 1e-3, {"refined": exact}),
        ("wrong", 2.0, 1e-3, {}),
        ("wrong", 1.03, 1e-3, {"refined": exact}),
        ("wrong", 1.03, 1e-7, {}),
        # no break within 40%, and a tenth of a percent off
        ("not shown", 1.0, 1e-3, {"theta": [6.038956701232997, 0.32253815294132326, 1.0045482589579533]}),
    ],
)
def test_a_loose_solver_leaves_open_what_its_steps_may_explain(answer, factor, rtol, settings):
    """At SciPy's default tolerance the cost's slope over any steps is off by 2% of the solution's: no breaks show how far."""

    def cost(x):
        return solve_ivp(
            lambda t, z: [z[1], -x[0] * z[0] - x[1] * z[1]],
            (0, 4),
            [x[2], 0.0],
            "DOP853" if "theta" in settings or rtol < 1e-6 else "RK45",
            rtol=rtol,
            atol=rtol / 1000,
        ).y[0, -1]

    given = {"theta": [8.0, 0.3, 0.9], "calls": 2000, **settings}
    slope = complex_step(exact)
    report = bench.examine(cost, grad=lambda x: slope(x) * [factor, 1.0, 1.0], **given)
    assert report.derivative == answer, str(report)


def bounce(x, **settings):
    """Return a cost of height and speed of a bouncing ball with drag after 1.2 s; ``x`` is height, speed, restitution."""

    def hit(_t, z):
        return z[0]

    hit.terminal, hit.direction = True, -1
    t, z = 0.0, x[:2]
    while True:
        path = solve_ivp(lambda _t, z: (z[1], -9.81 - 0.1 * z[1] * abs(z[1])), (t, 1.2), z, events=hit, **settings)
        t, z = path.t[-1], path.y[:, -1]
        if path.status == 0:
            return (z[0] - 0.5) ** 2 + 0.1 * z[1]
        z = [1e-12, -x[2] * z[1]]


def bounced(theta, factor):
    """Return the report on the gradient of :func:`bounce` by tight tolerances, times a factor."""

    def gradient(x):
        steps = 1e-5 * np.array([np.eye(3), -np.eye(3)])
        up, down = ([bounce(x + step, rtol=1e-10, atol=1e-12) for step in side] for side in steps)
        return factor * np.subtract(up, down) / 2e-5

    return bench.examine(bounce, theta, grad=gradient, calls=3000, progress=False)


@pytest.mark.parametrize("theta", [[1.0, 0.5, 0.8], pytest.param([0.9, 0.2, 0.85], marks=pytest.mark.slow)])
def test_jumps_of_events_do_not_bound_what_the_steps_of_a_solver_explain(theta):
    """The number of bounces makes up the cost on a long line, so that a few breaks there say nothing of the solver's steps."""
    report = bounced(theta, 1.0)
    assert report.derivative in ("right", "not shown"), str(report)


def test_jumps_of_events_excuse_no_wrong_gradient():
    """The jumps of a bounce more or less are as high as the cost, and no solver's steps turn a sign."""
    report = bounced([1.0, 0.5, 0.8], np.array([-0.5, -0.1, -0.7]))
    assert report.derivative == "wrong", str(report)


def test_one_kink_may_be_all_that_a_very_loose_solver_shows():
    """Heun's method with a tolerance of 0.1 changes its sequence of steps once on a long line, and errs by 8%."""

    def cost(x):
        z, t, dt = x[0], 0.0, 0.2
        while t < 1.0:
            dt = min(dt, 1.0 - t)
            first, second = -x[1] * z, -x[1] * (z - dt * x[1] * z)
            ratio = abs(dt * (second - first) / 2.0) / 0.1
            if ratio <= 1.0:
                z, t = z + dt * (first + second) / 2.0, t + dt
            dt *= min(3.0, max(0.3, 0.9 / np.sqrt(max(ratio, 1e-12))))
        return z * z

    def gradient(x):
        return np.array([2.0 * x[0], -2.0 * x[0] ** 2]) * np.exp(-2.0 * x[1])

    assert bench.examine(cost, [0.8, 1.5], grad=gradient, calls=1500, progress=False).derivative == "not shown"
