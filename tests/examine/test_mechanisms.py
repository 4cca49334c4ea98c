"""How gradients of engines fail, imitated in NumPy: each is named, and a right gradient beside it passes."""

import re
import subprocess
import sys
from functools import partial

import mechanisms
import numpy as np
import pytest
import simulators

import bench
from bench.errors import UserError
from bench.examine import lines
from bench.examine.judged import GroupSize
from bench.examine.steps import changing_loop
from bench.examine.subspace import groups_of
from bench.report.text import number
from bench.simulator.simulator import Simulator
from bench.simulator.tree import ParameterTree

examine = partial(bench.examine, progress=False, calls=3000)
START = [0.7, 0.3]


def swing(x, steps=20):
    return mechanisms.swinging(x, steps)


def slope(x, steps=20):
    return mechanisms.swinging(x, steps, slope=True)


# ------------------------------------------------------------------------------------- adaptive, overwritten


def separate(rtol, calls=3000, forgotten=0.0, **settings):
    """Return the report on an adjoint equation that is solved separately, less a share of one of its terms."""

    def grad(x):
        return mechanisms.separate(x, rtol, forgotten=forgotten)

    start = [1.0, 1.0, 0.5]
    return examine(lambda x: mechanisms.adaptive(x, rtol), start, grad=grad, calls=calls, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-3, 1e-4])
def test_a_separately_solved_adjoint_is_a_discretisation_gap(rtol):
    report = separate(rtol)
    assert (report.status, report.cause) == (3, "adaptive"), str(report)
    assert separate(rtol, calls=1500, refined=mechanisms.refined).cause == "adaptive"


@pytest.mark.slow
def test_an_adjoint_equation_without_a_term_is_wrong_beside_adaptive_steps():
    for settings in ({}, {"refined": mechanisms.refined}):
        report = separate(1e-4, forgotten=0.03, **settings)
        assert (report.status, report.cause) == (1, "missing_term"), str(report)


def test_a_small_error_is_not_decided_where_the_budget_ends_before_the_search_for_jumps():
    report = separate(1e-4, calls=120)
    assert (report.status, report.cause) == (3, "undecided"), str(report)
    assert "adaptive steps may explain it" in report.conclusion
    assert "0.10%" in report.conclusion
    assert "refined=COST" in report.advice


def test_a_small_jump_on_a_curved_line_is_found():
    """The largest changes of slope on the line are those of its bends, 40 times the jump."""
    line = lines.scan(lambda t: np.cos(t) + 1e-4 * (t > 1.2345), np.ones(1), 1e-16)
    assert [one.at for one in line.jumps] == pytest.approx([1.2345], abs=1e-5)


# ------------------------------------------------------------------------------------- noise and precision


@pytest.mark.parametrize(
    ("size", "chance", "causes"),
    [
        (1e-16, 0.5, ["smooth"]),
        (1e-3, 0.5, ["noisy", "smooth"]),
        (1e-3, 0.03, ["noisy", "smooth", "undecided", "unsettled"]),
    ],
)
def test_noise_is_never_a_state(size, chance, causes):
    """Two pairs of equal calls are often alike: of two values once in 8, and of rare noise nearly always."""
    for seed in range(40):
        random = np.random.default_rng(seed)

        def cost(x, random=random):
            return swing(x) + size * (random.random() < chance)

        report = examine(cost, START, grad=slope, calls=60)
        assert report.cause in causes, seed
        assert not report.repeats.has_state, seed


@pytest.mark.parametrize(
    "cost",
    [
        lambda x: float(np.floor(8 * x[0]) + x[0] * 0.5),
        lambda x: float(np.round(x[0] ** 2, 7)),
        lambda x: 0.5 * x[0] + 1e-7 * np.floor(1e7 * x[0]),
    ],
)
def test_float64_is_not_taken_for_float32(cost):
    report = examine(cost, [0.75], grad=lambda x: [0.5])
    assert report.precision == "float64"


# ------------------------------------------------------------------------------------- tolerance, zeros, raised


def test_errors_within_the_tolerance_are_warnings_with_their_size():
    def off(x):
        return slope(x) * [1, 1 + 1e-3]

    strict = examine(swing, START, grad=off)
    assert strict.status == 1
    assert re.search(r"theta\[1\]: .* off by 0\.1", strict.conclusion)
    assert strict.size == pytest.approx(1e-3, rel=0.01)
    report = examine(swing, START, grad=off, tolerance={"theta[1]": 2e-3})
    assert report.status == 0, str(report)
    assert "small error, within the tolerance" in str(report)
    assert examine(swing, START, grad=off, tolerance={"theta[0]": 2e-3}).status == 1
    with pytest.raises(UserError, match=r"unknown input 'theta.7.'"):
        examine(swing, START, grad=off, tolerance={"theta[7]": 1e-3})


# ------------------------------------------------------------------------------------- inputs


def test_sigma_by_input():
    theta = {"mass": 1.0, "gains": np.array([1.0, 2.0])}
    (found,) = examine(
        lambda p: p["mass"] ** 2 + p["gains"][0] * p["gains"][1], theta, sigma={"mass": 0.1, "gains": [0.0, 0.2]}
    ).smoothed
    np.testing.assert_allclose(found.gradient, [2.0, 1.0], atol=0.05)  # gains[0] has no noise
    rows = examine(lambda x: x @ x, [1.0, 2.0], sigma=np.array([[0.1, 0.2], [0.2, 0.4]]))
    assert [one.sigma for one in rows.smoothed] == [0.2, 0.4]
    with pytest.raises(UserError, match="unknown input 'mas'; did you mean 'mass'"):
        examine(abs, theta, sigma={"mas": 0.1})


@pytest.mark.parametrize("batch", ["columns:64", 64])
def test_a_batch_of_a_fixed_width(batch):
    def cost(x):
        assert x.shape == (2, 64)
        return (x**3).sum(axis=0)

    report = examine(cost, [1.0, 2.0], grad=lambda x: 3 * x**2, batch=batch)
    assert (report.status, report.batch) == (0, "columns:64")
    with pytest.raises(UserError, match="unknown batch 'loop:4'"):
        examine(cost, [1.0, 2.0], batch="loop:4")


def test_what_the_cost_prints_is_kept_and_counted(capsys):
    def cost(x):
        print("step done")
        return swing(x)

    report = examine(cost, START, grad=slope, calls=20)
    assert capsys.readouterr().out == ""
    assert len(report.printed) == report.spent.costs
    assert "printed" in str(report)


# ------------------------------------------------------------------------------------- remarks


@pytest.mark.parametrize(
    "cost",
    [
        lambda t: np.tanh(300 * t),
        lambda t: np.exp(-((t * 100) ** 2)),
        lambda t: np.sqrt(t * t + 1e-6),
        # a change in the last digits, as of forces that are added in another order
        lambda t: 1e6 * np.sin(t) + 1e-10 * (t > 0.3),
        # noise that is a function of theta, as from a loose solver, has second differences of every size
        lambda t: np.sin(t) + 1e-6 * np.sin(1e7 * t) * np.cos(3.1e7 * t),
    ],
)
def test_steep_and_rough_lines_have_no_breaks(cost):
    assert not lines.scan(lambda t: cost(t - 0.113), np.ones(1), 1e-16).breaks


# ------------------------------------------------------------------------------------- large theta


WIDE = np.random.default_rng(1)
SIZES = np.exp(2.0 * WIDE.standard_normal(10_000)) * WIDE.choice([-1, 1], 10_000)
"""Slopes of very different sizes: a few components are 1000 times as large as most."""
PLACES = WIDE.uniform(0.5, 1.5, 10_000)


def examined(factor):
    """Examine 10,000 inputs with a gradient that is off by a factor for each."""
    return examine(
        lambda x: float(SIZES @ np.sin(x)),
        PLACES,
        grad=lambda x: factor * SIZES * np.cos(x),
        calls=4000,
    )


@pytest.mark.parametrize("factor", [-1.0, 1.1])
def test_one_wrong_number_among_10_000_is_not_within_the_tolerance(factor):
    """It changes the slope of its group by less than 0.4%, in proportion less than a tolerated error of the largest number."""
    report = examined(np.where(np.arange(10_000) == 7360, factor, 1.0))
    assert report.derivative == "wrong"
    assert "theta[7360]" in report.conclusion


@pytest.mark.parametrize(("count", "tolerated"), [(10_000, 0.04), (4, 1.0)])
def test_the_tolerance_along_a_random_direction_of_up_to_10_000_numbers(count, tolerated):
    assert GroupSize(count, allowed=1.0, slope=1.0).tolerated == pytest.approx(tolerated)


def test_errors_of_10_000_numbers_within_the_tolerance_are_right():
    report = examined(1.0 + 9e-5 * WIDE.choice([-1, 1], 10_000))
    assert (report.derivative, report.status) == ("right", 0)
    assert any("within the tolerance" in text for text in report.warnings)


@pytest.mark.slow
def test_the_error_of_one_number_that_its_group_may_hide_is_stated():
    report = examined(1.0)
    assert report.derivative == "right"
    assert 0 < report.hidden < 0.1
    assert f"an error of one number in a group below {number(100 * report.hidden)}%" in str(report)


MILLION = """
import time
import numpy as np
import bench
from bench.measure.timing import peak_memory_mb

random, n = np.random.default_rng(0), SIZE // 2
theta = {"first": random.standard_normal(n), "bias": random.standard_normal(100), "second": random.standard_normal(n)}
mix = random.standard_normal(n) / np.sqrt(n)

def cost(p):
    return float(np.tanh(mix @ p["first"]) + np.mean(p["second"] ** 2) + 0.01 * np.sin(p["bias"]).sum())

def grad(p):
    y = np.tanh(mix @ p["first"])
    return {"first": (1 - y * y) * mix, "bias": 0.01 * np.cos(p["bias"]), "second": 0 * p["second"]}

started = time.process_time()
report = bench.examine(cost, theta, grad=grad, progress=False, budget=240)
print(report.status, report.cause, "second, along" in report.conclusion)
print(time.process_time() - started, peak_memory_mb() * 2**20 / 1e9)
"""


@pytest.mark.parametrize(
    "size", [pytest.param(100_000, marks=pytest.mark.slow), pytest.param(1_000_000, marks=pytest.mark.full)]
)
def test_a_million_inputs_take_less_than_a_gigabyte_and_the_wrong_array_is_named(size):
    code = MILLION.replace("SIZE", str(size))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    first, second = done.stdout.splitlines()[-2:]
    assert first == "1 disconnected True"
    seconds, gigabytes = map(float, second.split())
    assert gigabytes < 1.0
    assert seconds < 125.0  # of processor time: 60 s for a million, and as much again on a slow machine


def test_groups_cover_every_number_once():
    for theta in (np.ones(1000), {"a": np.ones(50), "b": [np.ones(3), 2.0]}, {f"x{i}": np.ones(7) for i in range(100)}):
        layout = ParameterTree(theta)
        groups = groups_of(layout, layout.scales(), 0)
        assert [i for g in groups for i in range(g.first, g.last)] == list(range(layout.vector.size))
        assert len(groups) <= 16


def test_a_cost_that_depends_on_the_call_before_is_named():
    given = mechanisms.WarmStarted()
    report = bench.examine(given.cost, [1.0, 2.0], grad=given.gradient, calls=3000, progress=False)
    assert "the cost depends on the call before it" in report.spread_text


def test_a_loop_without_a_condition_has_a_length_too():
    start = np.array([0.6, 1.2])
    simulator = Simulator(simulators.bounces, ParameterTree(start))
    assert re.fullmatch(
        r"the loop at simulators\.py:\d+", changing_loop(simulator, np.outer(start, [0.2, 0.6, 1.5]), None)
    )
    fixed = Simulator(swing, ParameterTree(START))
    assert changing_loop(fixed, np.outer(START, [0.2, 0.6]), None) == ""


def test_a_while_loop_of_jax_that_counts_has_a_fixed_length():
    jax = pytest.importorskip("jax")
    loop = jax.lax

    def counted(x):
        return jax.jit(lambda y: loop.fori_loop(0, 5, lambda i, z: 0.5 * z, y))(x[0])

    def adaptive(x):
        return loop.while_loop(lambda z: z[0] > 0.1, lambda z: (0.5 * z[0], z[1] + 1), (x[0], 0))[0]

    def inside(x):
        return loop.scan(lambda c, _: (adaptive([c]), None), x[0], None, length=2)[0]

    def flagged(x):
        """Return the same with the condition in the state, as equinox has it."""
        return loop.while_loop(lambda z: z[1], lambda z: (0.5 * z[0], z[0] > 0.1), (x[0], True))[0]

    thetas = np.array([[1.0, 2.0]])
    for cost, found in ((counted, ""), (adaptive, "a while loop"), (inside, "a while loop"), (flagged, "a while loop")):
        assert changing_loop(Simulator(cost, ParameterTree([1.0]), "jax"), thetas, None) == found, cost
