"""`bench.examine`: right gradients pass, wrong ones are named, jumps are found, and the budget holds."""

import contextlib
import dataclasses
import math
import signal
import time
import warnings
from collections import namedtuple
from functools import partial

import numpy as np
import pytest

import bench
from bench import cli
from bench.errors import UserError
from bench.examine import command, smoothing, text
from bench.examine.lines import Break, LineScan, scan
from bench.simulator import imports, simulator
from bench.simulator.simulator import Simulator
from bench.simulator.tree import ParameterTree

examine = partial(bench.examine, progress=False, budget=20)


def bowl(x):
    return float(np.sin(x[0]) * x[1] + x[1] ** 3)


def slope(x):
    return [math.cos(x[0]) * x[1], math.sin(x[0]) + 3 * x[1] ** 2]


# ------------------------------------------------------------------------------------------------ theta


@dataclasses.dataclass
class Body:
    mass: float
    gains: np.ndarray


Pair = namedtuple("Pair", "left right")


@pytest.mark.parametrize(
    ("theta", "names"),
    [
        (2.0, ["theta"]),
        ({"legs": [{"k": 1.0}, {"k": 2.0}]}, ["legs[0].k", "legs[1].k"]),
        (Body(1.0, np.ones((1, 2))), ["mass", "gains[0,0]", "gains[0,1]"]),
        (Pair(1.0, (2.0, 3.0)), ["left", "right[0]", "right[1]"]),
    ],
)
def test_theta_is_taken_apart_and_put_together(theta, names):
    layout = ParameterTree(theta)
    assert [layout.name(i) for i in range(layout.vector.size)] == names
    built = layout.unflatten(layout.vector + 1)
    assert type(built) is type(theta) or isinstance(theta, list)
    np.testing.assert_array_equal(layout.flatten(built), layout.vector + 1)


@pytest.mark.parametrize(
    ("theta", "match"),
    [({}, "no numbers"), ("mass", "real numbers"), ([math.nan], "not finite"), ({"a": 1j}, "real numbers")],
)
def test_theta_without_real_numbers_is_bad_input(theta, match):
    with pytest.raises(UserError, match=match):
        ParameterTree(theta)


def test_gradients_are_matched_by_name_whatever_their_order():
    """JAX sorts the keys of a dict: a gradient in its order is right."""
    layout = ParameterTree({"speed": 1.0, "mass": 2.0})
    np.testing.assert_array_equal(layout.flatten({"mass": 20.0, "speed": 10.0}), [10.0, 20.0])
    with pytest.raises(UserError, match=r"has shape mass .*, spin"):
        layout.flatten({"mass": 20.0, "spin": 10.0})


MATRIX = np.arange(1.0, 7.0).reshape(2, 3)


@pytest.mark.parametrize(
    ("theta", "turned", "said"),
    [
        (np.ones(2), lambda g: g[:1].tolist(), r"shape \(1,\), and theta has shape \(2,\)"),
        (MATRIX, lambda g: g.T.tolist(), r"shape \(3, 2\), and theta has shape \(2, 3\): is it transposed\?"),
        ({"w": MATRIX}, lambda g: {"w": g["w"].T}, r"shape w \(3, 2\), and theta has shape w \(2, 3\): is it trans"),
        (np.ones(4), lambda g: g[:, None], r"shape \(4, 1\), and theta has shape \(4,\)$"),
        (MATRIX, lambda g: g.ravel(), ""),
        (MATRIX.tolist(), lambda g: np.array(g), ""),
        ([MATRIX, 2.0], lambda g: tuple(g), ""),
        ({"w": MATRIX}, lambda g: g["w"], ""),
        (2.0, lambda g: [[g]], ""),
    ],
)
def test_gradient_has_the_shape_of_theta(theta, turned, said):
    layout = ParameterTree(theta)

    def cost(x):
        return float(layout.flatten(x) @ layout.flatten(x))

    def grad(x):
        return turned(layout.unflatten(2 * layout.flatten(x)))

    if said:
        with pytest.raises(UserError, match=f"the gradient has {said}"):
            examine(cost, theta, grad=grad, calls=60)
    else:
        assert examine(cost, theta, grad=grad, calls=60).status == 0


def test_a_library_that_cannot_differentiate_the_cost_is_bad_input():
    with pytest.raises(UserError, match=r"jax cannot differentiate the cost: .* or give grad=FUNCTION \("):
        examine(lambda x: np.sin(np.asarray(x)).sum(), [1.0, 2.0], grad="jax")


def shifted(x):
    x[0] += 1.0
    return x[0] - 1.0


@pytest.mark.parametrize(
    ("cost", "theta", "settings"),
    [
        (lambda p: p.pop("mass") ** 2, {"mass": 2.0}, {}),
        (shifted, [1.0], {"grad": np.ones_like, "batch": "columns"}),
        (shifted, [1.0], {"grad": lambda x: np.multiply(x, 0, out=x) + 1}),
    ],
)
def test_changes_of_theta_change_no_verdict(cost, theta, settings):
    report = examine(cost, theta, calls=60, **settings)
    assert report.status == 0, str(report)


def test_scale_of_zero_is_that_of_its_array():
    np.testing.assert_allclose(ParameterTree({"drag": 2e4, "x": [0.0, 3.0], "y": 0.0}).scales(), [2e4, 3.0, 3.0, 1.0])


# -------------------------------------------------------------------------------------------- gradients


def test_right_gradient_passes_with_every_digit():
    report = examine(bowl, [1.0, 0.5], grad=slope, sigma=[0.003])
    assert (report.status, report.cause) == (0, "smooth")
    report.assert_right()
    np.testing.assert_allclose(report.frame["difference"][:2], slope([1.0, 0.5]), rtol=1e-7)
    assert report.check.order == pytest.approx(2.0, abs=0.1)


def test_a_library_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setattr(simulator, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="grad=jax needs a library that is not installed: pip install jax"):
        bench.examine(lambda x: x[0], [1.0], grad="jax")


# -------------------------------------------------------------------------------------- jumps and noise


def test_lines_find_jump_and_kink_where_they_are_and_none_in_rounding():
    line = scan(lambda t: (t > 0.37) * 0.2 + abs(t + 0.81) + np.sin(3 * t), np.ones(1), noise=1e-15)
    assert [(b.kind, round(b.at, 3)) for b in line.breaks] == [("kink", -0.81), ("jump", 0.37)]
    assert line.jumps[0].size == pytest.approx(0.2, rel=1e-3)
    assert line.breaks[0].size == pytest.approx(2.0, rel=1e-2)
    rough = np.random.default_rng(0)
    assert not scan(lambda t: 1e-9 * rough.standard_normal(t.size), np.ones(1), noise=1e-9).breaks


@pytest.mark.parametrize(
    ("places", "heights", "tread"),
    [
        ([0.0, 1.0, 2.0, 4.0], [0.3] * 4, 0.3),
        ([0.0, 1.0, 2.0], [0.3] * 3, 0.0),
        ([0.0, 1.0, 2.0, 4.0], [0.3, 0.3, 0.32, 0.3], 0.0),
        ([0.0, 1.0, 2.1, 4.0], [0.3] * 4, 0.0),
    ],
)
def test_a_tread_is_the_height_of_four_equal_jumps_at_even_distances(places, heights, tread):
    breaks = tuple(Break("jump", *each) for each in zip(places, heights, strict=True))
    line = LineScan(np.ones(1), np.zeros(2), np.zeros(2), breaks, steps=False)
    assert line.tread == pytest.approx(tread)


@pytest.fixture(scope="module")
def right():
    return examine(bowl, [1.0, 0.5], grad=slope)


def jumpy(missed, *heights):
    """A line for each height with four equal jumps at even distances, of which the gradient misses a share."""
    found = [tuple(Break("jump", float(place), height) for place in range(4)) for height in heights]
    return [LineScan(np.ones(2), np.zeros(2), np.zeros(2), breaks, False, missed) for breaks in found]


@pytest.mark.parametrize(
    ("found", "cause"),
    [
        ({"lines": jumpy(0.005, 0.3, 0.3)}, "smooth"),
        ({"lines": jumpy(0.02, 0.3, 0.3)}, "staircase"),
        ({"lines": jumpy(0.02, 0.3, 0.4)}, "smooth"),
        ({"lines": jumpy(0.2, 0.3, 0.4)}, "jumps"),
    ],
)
def test_what_was_found_decides_the_cause_and_the_status(right, found, cause):
    report = dataclasses.replace(right, **found)
    assert (report.cause, report.status) == (cause, int(cause != "smooth"))


def test_a_check_under_other_noise_decides_too(right):
    report = dataclasses.replace(right, more=[dataclasses.replace(right.check, cause="missing_term")])
    assert (report.cause, report.status) == ("missing_term", 1)


def test_an_integral_that_its_panels_do_not_resolve_tells_nothing():
    report = bench.examine(
        lambda x: float(np.sin(5e3 * x[0])), [0.3], grad=lambda x: 5e3 * np.cos(5e3 * x), sigma=0.01, calls=4000
    )
    assert [math.isnan(line.missed) for line in report.lines] == [True]


def test_bias_at_a_jump_is_that_of_the_closed_form():
    """f = x^2 + 1[x > 0]: grad J = 2 theta + pdf(theta / sigma) / sigma, of which each gradient sees 2 theta."""
    theta, sigma = 0.1, 0.2
    missed = math.exp(-0.5 * (theta / sigma) ** 2) / math.sqrt(2 * math.pi) / sigma
    report = examine(lambda x: x[0] ** 2 + (x[0] > 0), [theta], grad=lambda x: 2 * x, sigma=sigma, batch="columns")
    (found,) = report.smoothed
    assert abs(found.norm - (2 * theta + missed)) < 4 * found.error
    assert found.bias_low <= missed <= found.bias_high
    assert report.status == 1
    assert report.cause == "biased"
    assert (found.best.name, found.best.calls) == ("smoothing", 2 * found.best.samples)
    assert dataclasses.replace(report, expect="jumps").status == 0  # sigma measures what the jumps do
    assert dataclasses.replace(report, expect="jumps", lines=[]).status == 1  # a bias without jumps is not expected


# ------------------------------------------------------------------------------------- how it is called


def test_batches_are_told_from_the_result():
    def columns(x):
        assert x.shape == (2, x.shape[1])
        return (x**2).sum(axis=0)

    report = examine(columns, [1.0, 2.0])
    assert (report.status, report.batch) == (0, "columns")

    def rows(x):
        assert x.shape[1] == 2
        return (x**2).sum(axis=1)

    assert examine(rows, [1.0, 2.0]).batch == "rows"
    assert examine(bowl, [1.0, 2.0]).batch == "loop"


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"grad": "tensorflow"}, "unknown grad"),
        ({"batch": "column"}, "did you mean 'columns'"),
        ({"budget": "soon"}, "is not a duration"),
        ({"noise": -1}, "whole number"),
        ({"calls": 2.5}, "is not a number of calls"),
        ({"horizons": np.array([3.5, np.inf])}, "horizons=3.5,inf are not numbers of steps"),
        ({"horizons": [0, 4]}, "are not numbers of steps"),
        ({"sigma": np.float32(-0.5)}, "above 0"),
        ({"sigma": [[0.1, 0.2], 0.3]}, "a list of numbers"),
        ({"grad": np.ones(2)}, "a function of theta"),
        ({"refined": True}, "refined is a function of theta, not bool"),
        ({"expect": "wrong_factor"}, "a wrong gradient cannot be expected"),
        ({"grad": lambda x, y: x}, r"the gradient must accept \(theta\): .* missing"),
        ({"noise": 3}, r"the cost must accept \(theta, w\): "),
        ({"horizons": [1, 2]}, r"the cost must accept \(theta, steps\): "),
        ({"cost": lambda x: (1.0, {})}, "the cost returned a tuple of 2 values"),
        ({"grad": lambda x: 3 * x, "refined": lambda x, rtol: 1.0}, r"refined must accept \(theta\): .* missing"),
        ({"grad": lambda x: 3 * x, "refined": lambda x: x}, "refined cannot be called at theta: it returned an array"),
    ],
)
def test_bad_settings_say_what_is_allowed(settings, match):
    with pytest.raises(UserError, match=match):
        examine(**{"cost": bowl, "theta": [1.0, 0.5]} | settings)


def test_a_tuple_of_one_number_is_a_cost():
    assert examine(lambda x: (x @ x,), [1.0, 0.5], grad="jax", calls=500).status == 0


@pytest.mark.parametrize(
    ("error", "advice"),
    [(RuntimeError("contact solver diverged"), "Give a theta at"), (KeyError("mass"), "It must accept")],
)
def test_advice_on_a_cost_that_raises_depends_on_what_it_raises(error, advice):
    def cost(x):
        raise error

    with pytest.raises(UserError, match=rf"cannot be called at theta: {type(error).__name__}: .*\. {advice}"):
        examine(cost, [1.0])


def test_budget_bounds_everything(now):
    def slow(x):
        now[0] += 0.02
        return bowl(x)

    report = bench.examine(slow, [1.0, 0.5], grad=slope, sigma=[0.01, 0.1], progress=False, budget="1s")
    assert 0.5 < now[0] < 1.1
    assert "not done within the budget" in str(report)


def test_cost_that_hangs_is_interrupted_when_the_budget_ends():
    calls = []

    def hangs(x):
        calls.append(1)
        while len(calls) > 4:  # the first call, and differences of one component
            with contextlib.suppress(Exception):  # as a simulator may that tries again
                time.sleep(60)
        return bowl(x)

    began = time.perf_counter()
    report = bench.examine(hangs, [1.0, 0.5], progress=False, budget=0.3)
    assert time.perf_counter() - began < 30.0  # one uninterrupted call takes 60 s
    assert (report.status, report.cause) == (3, "undecided")
    assert "1 of 2 components" in report.conclusion
    assert report.cost == bowl([1.0, 0.5])
    with pytest.raises(UserError, match="the first call of the cost took longer than compile_budget"):
        bench.examine(lambda x: time.sleep(60), [1.0], progress=False, compile_budget=0.1)


def test_alarm_of_someone_else_is_left_alone():
    def mine(*ignored):
        raise RuntimeError("not this one")

    signal.signal(signal.SIGALRM, mine)
    try:
        assert examine(bowl, [1.0, 0.5], grad=slope, sigma=None).status == 0
        assert signal.getsignal(signal.SIGALRM) is mine
    finally:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


# ----------------------------------------------------------------------------------- files, command, pytest


@pytest.mark.slow
def test_files_are_text_tables_and_charts(tmp_path):
    report = examine(bowl, [1.0, 0.5], grad=slope, sigma=[0.003, 0.1])
    names = {path.name for path in report.save(tmp_path / "out")}
    assert {"report.txt", "derivatives.csv", "sigmas.csv", "steps.png", "lines.png"} <= names
    assert (tmp_path / "out" / "report.txt").read_text() == f"{report}\n"


@pytest.fixture
def mysim(tmp_path):
    path = tmp_path / "mysim.py"
    path.write_text(
        "theta = [1.0, 0.5]\n"
        "def cost(x): return x[0] ** 2 * x[1]\n"
        "def right(x): return [2 * x[0] * x[1], x[0] ** 2]\n"
        "def wrong(x): return [2 * x[0] * x[1], -x[0] ** 2]\n"
        "def leaves(x): raise SystemExit(0)\n"
        "def nothing(x): pass\n"
    )
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{0}:cost", "grad={0}:rihgt"], "did you mean 'right'"),
        (["nothing.py:cost"], "there is no file"),
        (["{}:cost", "grad=jaxx"], "did you mean 'jax'"),
        (["{}:cost", "thta=1"], "did you mean 'theta'"),
        (["{}:cost", "theta=1,x"], "is not a list of numbers"),
        (["{}:cost", "calls=-5"], "calls=-5 is not a whole number of at least 1"),
        ([], "name one cost"),
        (["{}:leaves"], "it ended the process by sys.exit"),
        (["{}:nothing"], "the cost returned None"),
        (["{}:cost", "sigma=0"], "numbers above 0"),
        (["{}:cost", "sigma="], "sigma= is not a list of numbers"),
        (["{}:cost", "theta=1"], "index 1 is out of bounds"),
        (["{0}:cost", "calls=20", "save={0}/folder"], "cannot be"),
    ],
)
def test_command_says_what_is_wrong_with_its_words(mysim, capsys, words, said):
    assert cli.main(["examine", *(word.format(mysim) for word in words)]) == 2
    answer = capsys.readouterr()
    assert said in answer.err
    assert answer.out == ""


@pytest.mark.parametrize("file", ["save", "baseline"])
def test_a_file_that_cannot_be_used_is_refused_before_the_examination(mysim, file):
    mysim.write_text(f"{mysim.read_text()}calls = []\ndef counted(x): calls.append(x); return cost(x)\n")
    with pytest.raises(UserError, match=r"mysim\.py"):
        command.run([f"{mysim}:counted", f"{file}={mysim}", "calls=20", "--quiet"])
    assert not imports.load_module(str(mysim)).calls


def test_own_arithmetic_does_not_warn_and_the_cost_still_does():
    """Warnings of the cost are kept with what it prints."""

    def cost(x):
        np.float64(1.0) / np.float64(0.0)
        return float(x[0]) if x[0] <= 1.0 else 1e308 * (-1.0 if int(1e6 * x[0]) % 2 else 1.0)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(bench.UserError, match="divide by zero"):
            examine(cost, [1.0])
        with np.errstate(divide="ignore"):
            str(examine(cost, [1.0], grad=lambda x: [1e308]))


@pytest.mark.parametrize(
    ("error", "low", "high", "cause"),
    [
        (0.01, 0.2, 0.4, "biased"),
        (0.5, 0.2, 0.4, "spread"),
        (0.5, 0.0, 0.05, "spread"),
        (0.01, 0.06, 0.2, "spread"),
        (0.01, 0.0, 0.09, ""),
        (0.0, 0.0, 0.0, ""),
    ],
)
def test_a_bias_interval_decides_where_grad_j_is_known(error, low, high, cause):
    norm = float(error > 0)
    assert smoothing.Smoothed(0.1, np.zeros(2), error, norm, 64, 0.0, low, high, math.nan, "", ()).cause == cause


def test_the_line_taken_out_of_the_terms_leaves_their_mean():
    """d = u^3 has E[d u] = 3. A line fitted to the terms that it is taken out of would lean to what they happen to be."""
    draw = np.random.default_rng(0).standard_normal((4000, 1, 16))
    means = np.array([smoothing._terms(u, u[0] ** 3).mean() for u in draw])
    assert abs(means.mean() - 3.0) < 4 * means.std() / math.sqrt(means.size)


def test_size_of_a_gradient_is_without_the_share_of_its_noise():
    """Few pairs of a cost whose gradient is small beside their noise: J = 0.1 x0, E |estimate|^2 is more."""
    simulator = Simulator(
        lambda x: 0.1 * x[0] + np.sin(3.0 * x[1]) ** 3 + np.sin(4.0 * x[2]) ** 3, ParameterTree(np.zeros(3))
    )
    for seed in range(20):
        found = smoothing.measure_smoothed(simulator, 1.0, np.ones(3), None, seed, pairs=64)
        square = max(np.sum(found.gradient**2) - found.error**2, 0.0)
        assert found.norm == pytest.approx(math.sqrt(square))


def test_gradient_that_ends_the_process_is_no_success(mysim, capsys):
    assert cli.main(["examine", f"{mysim}:cost", "grad=leaves", "--quiet"]) == 1
    assert "raised: the gradient could not be computed" in capsys.readouterr().out


def test_the_next_command_replaces_a_setting(right):
    report = dataclasses.replace(right, command="python -m bench examine f.py:cost calls=300 sigma=0.1")
    assert text.again(report, "calls=600") == "python -m bench examine f.py:cost sigma=0.1 calls=600"


def test_the_advice_compares_the_gradient_without_noise_and_mirrored_draws():
    """Of x^3 at 1, whose smoothed gradient is 3 + 3 sigma^2, from 3 (x + sigma u)^2."""
    reports = {
        sigma: examine(lambda x: x[0] ** 3, [1.0], grad=lambda x: 3 * x**2, sigma=sigma, calls=6000)
        for sigma in (0.1, 0.5)
    }
    methods = {sigma: {m.name: m for m in report.smoothed[0].methods} for sigma, report in reports.items()}
    assert set(methods[0.1]) == {"plain", "gradient", "mirrored", "smoothing"}
    assert (methods[0.1]["plain"].samples, methods[0.1]["plain"].calls) == (1.0, 1.0)
    assert methods[0.5]["plain"].samples == math.inf  # 0.75 of 3.75
    assert methods[0.5]["mirrored"].calls < methods[0.5]["gradient"].calls
    assert reports[0.1].recommended(reports[0.1].smoothed[0]).name == "plain"
    assert reports[0.5].recommended(reports[0.5].smoothed[0]).name != "plain"


def test_noise_may_be_a_key_of_jax():
    jax = pytest.importorskip("jax")

    @jax.jit
    def cost(x, key):
        return (x[0] + 0.1 * jax.random.normal(key)) ** 2

    @jax.jit
    def slope(x, key):
        return 1.5 * jax.grad(cost)(x, key)

    given = {"noise": "key", "sigma": 0.1, "calls": 4000, "progress": False}
    report = bench.examine(cost, [1.0], grad="jax", **given)
    assert (report.derivative, report.use) == ("right", "usable"), str(report)
    assert bench.examine(cost, [1.0], grad=slope, **given).status == 1


def test_the_norm_of_the_gradient_is_shown_at_each_horizon():
    def cost(x, steps=10):
        return float(np.exp(0.1 * steps * x[0]))

    def slope(x, steps=10):
        return [0.1 * steps * cost(x, steps)]

    report = bench.examine(cost, [0.5], grad=slope, horizons=[10, 40], calls=400, progress=False)
    norms = [one.norm for one in report.explained.growth]
    np.testing.assert_allclose(norms, [0.5 * slope([0.5], steps)[0] for steps in (10, 40)])
