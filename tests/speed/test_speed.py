"""Blocks, row-wise evaluation, compilations and timings: what makes runs fast must change no number."""

import itertools
import json
import math
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bench.plugins.backends import rows
from bench.plugins.backends.jax import JaxProblem
from classes import Jax, Penalty, Pushing, SemiImplicitEuler, Softplus
from helpers import loaded

from bench import cli
from bench.model import Compilations, blocks, compose, registry
from bench.run.session import RunSession
from bench.run.tasks import measure_cell

# ------------------------------------------------------------------------------------------------------------ blocks


@pytest.mark.parametrize(("most", "grain", "threads"), [(1024, 2, 2), (8192, 1, 1), (100, 1, 3)])
def test_blocks_are_alike_and_few(most, grain, threads):
    for count in (1, 1000, 1024, 1025, 100_000, 1_000_003):
        size = blocks.block_size(count, most, grain, threads)
        parts = -(-count // size)
        assert size % grain == 0
        assert size <= -(-most // grain) * grain
        assert parts * size - count < parts * grain + size
        assert parts == 1 or parts >= -(-count // most)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("own_theta", [False, True])
def test_blocks_cover_each_column_once(threads, own_theta):
    rng = np.random.default_rng(0)
    w, theta = rng.standard_normal((3, 101)), rng.standard_normal((2, 101 if own_theta else 1))
    seen = []

    def function(theta, w):
        seen.append(w.shape[1])
        return w[:2] * theta

    found = blocks.evaluate(function, theta, w, 16, threads, (2,))
    np.testing.assert_array_equal(found, w[:2] * theta)
    assert seen == [16] * 7


def test_failure_in_another_thread_is_raised():
    here, failed = threading.get_ident(), threading.Event()

    def fails(theta, w):
        if threading.get_ident() == here:
            failed.wait(60)
            return w
        failed.set()
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        blocks.evaluate(fails, np.zeros((1, 1)), np.zeros((1, 50)), 10, 2, (1,))


def test_small_batches_are_not_shared():
    assert [blocks.n_threads(count, 4, 512) for count in (0, 1, 700, 1000, 1500, 2048, 10**6)] == [1, 1, 1, 2, 3, 4, 4]


def test_threads_obey_the_environment(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert blocks.cores() == 1


def pushing(horizon=8, contact=None, **values):
    return compose(Pushing(horizon=horizon, **values), contact or Penalty(), SemiImplicitEuler())


@pytest.mark.parametrize(
    ("name", "grain"), [("jax", 16), ("torch", 16), ("numpy", 16), pytest.param("fused", 32, marks=pytest.mark.slow)]
)
def test_padding_and_sharing_change_no_result(name, grain):
    if reason := registry.find("backends", name).reason:
        pytest.skip(reason)
    problem = registry.make("backends", name).compile(pushing())
    w = np.random.default_rng(0).standard_normal((8, 130))
    theta = problem.program.theta0
    whole, costs = problem.grad(theta, w), problem.value(theta, w)
    problem.block, problem.grain, problem.threads = 32, grain, 2
    np.testing.assert_allclose(problem.grad(theta, w), whole, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(problem.value(theta, w), costs, rtol=1e-12)


@pytest.mark.parametrize(("count", "width"), [(1, 2), (9, 10), (300, 300)])
def test_a_batch_is_padded_to_a_multiple_of_2(monkeypatch, count, width):
    """A comparison at few samples measured 128 columns."""
    problem, widths = registry.make("backends", "jax").compile(pushing()), []
    problem.grain = 2
    monkeypatch.setattr(problem, "_value", lambda theta, w: widths.append(w.shape[1]) or np.zeros(w.shape[1]))
    problem.value(None, np.zeros((8, count)))
    assert widths == [width]


def test_padding_changes_no_digit():
    problem, w = registry.make("backends", "jax").compile(pushing()), np.random.default_rng(0).standard_normal((8, 128))
    whole = problem.grad(None, w)
    problem.grain = 2
    for count in (1, 101):
        np.testing.assert_array_equal(problem.grad(None, w[:, :count]), whole[:, :count])


# -------------------------------------------------------------------------------------------------------------- rows


def whole_and_by_rows(function, *arguments):
    traced = jax.make_jaxpr(function)(*arguments)
    found = rows.evaluate(traced.jaxpr, traced.consts, [rows.split(a) for a in arguments])
    return jax.tree.leaves(function(*arguments)), [rows.join(part) for part in found]


@pytest.mark.parametrize(
    "function",
    [
        lambda q, v: jnp.concatenate([q[1:2], v, jnp.ones((1, 5))])[::-1],
        lambda q, v: jnp.logaddexp(q, 0.0) @ jnp.ones((5, 5)) + jax.nn.softplus(v),
        lambda q, v: jnp.reshape(q, (-1,))[:5] + v[1] + jnp.broadcast_to(q[0], (5,)),
        lambda q, v: jax.lax.fori_loop(0, 3, lambda i, x: 0.5 * x + v, q),
        lambda q, v: jnp.zeros((0, 5)) * v[:0],
    ],
)
def test_row_wise_evaluation_gives_the_same_numbers(function):
    q, v = jnp.asarray(np.random.default_rng(0).standard_normal((2, 2, 5)))
    for whole, split in zip(*whole_and_by_rows(function, q, v), strict=True):
        assert whole.shape == split.shape
        np.testing.assert_allclose(split, whole, rtol=1e-15)


# ------------------------------------------------------------------------------------------------------ compilations


def test_a_sweep_compiles_each_shape_once():
    compilations = Compilations()
    for stiffness, sigma, beta in itertools.product((1e2, 1e3), (0.1, 0.3), (5.0, 20.0)):
        problem = Jax().compile(pushing(9, Softplus(stiffness=stiffness, beta=beta), sigma=sigma))
        problem.compilations = compilations
        theta, w = problem.program.theta0, np.ones((9, 20))
        problem.value(theta, w)
        problem.grad(theta, w)
        problem.grad(theta, w[:, :17])  # padded to as many columns
    assert compilations.made == len(compilations.shapes) == 2


def test_a_compile_time_stands_in_the_row_of_the_cell_that_compiled(monkeypatch):
    """It stood in every row: the sum of a run of 152 s was 1,038 s."""
    monkeypatch.setattr(JaxProblem, "grain", 8)  # the reference has another width
    given, cells = loaded(
        "scenes=[pushing]",
        "scene.pushing.horizon=7",
        "estimators=[fobg]",
        "sweep.stiffness=[100,1000]",
        "samples=8",
        "repeats=4",
        "reference.samples=512",
        "reference.tolerance=1",
        "compile_cache=null",
    )
    session = RunSession(given)
    first, second = (measure_cell(cell, session, cell.study) for cell in cells)
    assert first["compile_s"] > 0
    assert math.isnan(second["compile_s"])


@pytest.mark.slow
def test_run_counts_compilations_and_keeps_compiled_programs(tmp_path):
    words = [
        "scenes=[pushing]",
        "contacts=[softplus]",
        "estimators=[fobg]",
        "sweep.stiffness=[100,1000]",
        "sweep.sigma=[0.1,0.2]",
        "sweep.beta=[5,20]",
        "scene.pushing.horizon=7",
        "samples=8",
        "repeats=4",
        "reference.samples=4096",
        "reference.tolerance=1",
        f"compile_cache={tmp_path}/kept",
    ]
    assert cli.main([*words, f"results_dir={tmp_path}"]) == 0
    record = json.loads((tmp_path / "custom" / "run.json").read_text())
    assert record["compilations"] == record["distinct_shapes"] > 0
    assert record["machine"]["affinity"]
    assert record["machine"]["threads"]["blocks"] >= 1
    assert list((tmp_path / "kept").iterdir())


@pytest.mark.slow
def test_measured_compilation_is_not_taken_from_the_folder(tmp_path):
    from bench.plugins.backends import compiling

    theta, w = np.zeros(6), np.zeros((6, 3))
    made = []
    for measured in (False, False, True):
        compiling._known.clear()
        jax.clear_caches()
        compilations = Compilations(tmp_path)
        problem = Jax().compile(pushing(6))
        problem.compilations = compilations
        if measured:
            problem.reset_usage()
        problem.value(theta, w)
        made.append(compilations.made)
    assert made == [1, 0, 1]
