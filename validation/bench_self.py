"""Measures the harness and its backends beside programs written by hand: ``python validation/bench_self.py [FOLDER [PART...]]``.

Times are processor times of calls on one thread: other load changes their ratios little. Writes ``FOLDER/bench_self.csv`` (by default in
``results/bench_self``), from which ``docs/speed.md`` is written. With names of parts, such as ``overhead``, only these are
measured, and the other lines of the file stay.
"""

import compileall
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from speed import by_hand, native

from bench.experiment import config
from bench.experiment.by_name import compile_problem
from bench.experiment.grid import cells
from bench.measure import noise, timing
from bench.model import blocks, registry
from bench.run.execute import store_of
from bench.run.record import machine
from bench.run.tasks import blank_row

SUBJECTS = (
    ("fused", "penalty", "grad"),
    ("jax", "penalty", "grad"),
    ("torch", "penalty", "grad"),
    ("numpy", "penalty", "value"),
    ("implicit", "complementarity", "grad"),
)
"""Backend, contact law and method of the rollouts of ``pushing`` that are timed."""
SCENES = ("pushing", "pendulum", "cartpole", "double_pendulum", "hopper", "bounce_once")
"""Scenes whose gradients ``fused`` and ``jax`` are compared on."""
SIZES = (1_000, 10_000, 100_000, 1_000_000)
BY_HAND = {
    "jax": ("grad", by_hand.jax_gradient),
    "torch": ("grad", by_hand.torch_gradient),
    "numpy": ("value", by_hand.numpy_cost),
}
"""Method and program by hand with which a backend is compared."""
SMALL_SIZES = (1, 16, 100, 1_000, 10_000)
LEAST_BLOCK, BLOCKS = 0.02, 11
"""Least time of a block of equal calls [s], since the processor's clock is coarse across threads, and the number of pairs of blocks."""
LONGEST = 20.0
"""Time per call [s] above which larger batches are skipped."""
NATIVE_COLUMNS = 1024
SMALL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4", "timing=false")


def problem(backend, contact="penalty", scene="pushing"):
    """Compile a scene, ``pushing`` with 100 steps."""
    made = registry.make("scenes", scene, {"horizon": 100} if scene == "pushing" else {})
    law = registry.make("contacts", contact, {}) if getattr(made, "n_contacts", 0) else None
    return compile_problem(made, law, "semi_implicit_euler", backend)


def batch(compiled, count):
    """Return noise ``(n_w, count)``: at most 10,000 random columns, repeated."""
    drawn = noise.shared(0, compiled.program.scene.name, 1, min(count, 10_000), compiled.program.n_noise)[0].T
    return np.ascontiguousarray(np.tile(drawn, (1, -(-count // drawn.shape[1])))[:, :count])


def seconds(call):
    """Return the processor time per call [s], after a call that is not timed."""
    call()
    count, started = 0, time.process_time()
    while not count or time.process_time() - started < LEAST_BLOCK:
        call()
        count += 1
    return (time.process_time() - started) / count


def ratio(first, second, blocks=BLOCKS):
    """Return the median ratio of the processor times of two calls, in blocks that take turns."""
    return np.median([seconds(first) / seconds(second) for _ in range(blocks)])


def difference(found, expected):
    """Return the largest difference, relative to the largest number."""
    return np.abs(np.subtract(found, expected)).max() / np.abs(expected).max()


def measure_backends():
    """Yield the time of every subject and of the C kernel at every batch size, and the peak memory without noise and result."""
    for backend, contact, method in SUBJECTS:
        compiled = problem(backend, contact)
        for count in SIZES:
            w = batch(compiled, count)
            timing.reset_peak_memory()
            each = seconds(partial(getattr(compiled, method), compiled.program.theta0, w)) / count
            given = w.nbytes + 8 * count * (compiled.dim if method == "grad" else 1)
            name = f"{backend} {method}, {contact}, {count:g} rollouts"
            yield name, each * 1e6, "us"
            yield f"{name}: peak memory", timing.peak_memory_mb() - given / 2**20, "MB"
            if each * count * 10 > LONGEST:
                break
    compiled = problem("jax")
    kernel = native.gradient(compiled.program.scene, compiled.program.contact.stiffness)
    w = batch(compiled, 64)
    yield (
        "native C kernel: largest relative difference",
        difference(kernel(compiled.program.theta0, w), compiled.grad(w=w)),
        "",
    )
    for count in SIZES:
        columns = blocks.block_size(count, NATIVE_COLUMNS, native.LANES, 1)
        given = compiled.program.theta0[:, None], batch(compiled, count), columns, 1, (compiled.dim,)
        each = seconds(partial(blocks.evaluate, kernel, *given)) / count
        yield f"native C kernel, {count:g} rollouts", each * 1e6, "us"


def measure_overhead():
    """Yield the times of backends over those of the same rollouts by hand."""
    for backend, (method, written) in BY_HAND.items():
        compiled = problem(backend)
        theta, call = compiled.program.theta0, getattr(compiled, method)
        hand = written(compiled.program.scene, compiled.program.contact.stiffness)
        for count in SMALL_SIZES:
            w = batch(compiled, count)
            name = f"{backend} {method} over by hand, {count:g} rollouts"
            yield f"{name}: largest relative difference", difference(call(theta, w), hand(theta, w)), ""
            yield name, ratio(partial(call, theta, w), partial(hand, theta, w)), ""


def compare_backends():
    """Yield the ratio of the times of gradients by ``fused`` and by ``jax``."""
    for scene, count in itertools.product(SCENES, (1_000, 10_000)):
        both = [problem(backend, scene=scene) for backend in ("fused", "jax")]
        yield (
            f"fused over jax, {scene}, {count:g} rollouts",
            ratio(*(partial(p.grad, w=batch(p, count)) for p in both), 5),
            "",
        )


def measure_sweep():
    """Yield the times of a sweep by hand and by the harness, with their imports and compilations."""
    with tempfile.TemporaryDirectory() as folder:
        by_hand_s, text = python(str(Path(__file__).parent / "speed" / "sweep.py"))
        found = json.loads(text)
        words = [
            "name=sweep",
            "timing=false",
            "compile_cache=null",
            f"sweep.stiffness={sorted({row[0] for row in found})}",
        ]
        harness_s, _ = python("-m", "bench", *words, f"results_dir={folder}")
        rows = store_of(config.load([*words, f"results_dir={folder}"])).load().set_index(["stiffness", "estimator"])
    columns = ["variance", "mean_estimate", "reference_gradient"]
    differences = [
        max(map(difference, rows.loc[tuple(at), columns], values))
        for *at, values in ((r[0], r[1], r[2:]) for r in found)
    ]
    yield "a sweep: largest relative difference", max(differences), ""
    yield "a sweep by hand", by_hand_s, "s"
    yield "a sweep by the harness", harness_s, "s"
    yield "a sweep over by hand", harness_s / by_hand_s, ""


def measure_commands(side, count):
    """Yield the times of planning and resuming ``side``^2 cells, of ``list``, and of each of ``count`` small cells."""
    with tempfile.TemporaryDirectory() as folder:
        seeds, sigmas = (",".join(map(str, range(start, start + side))) for start in (0, 1))
        words = [*SMALL, f"sweep.seed=[{seeds}]", f"sweep.sigma=[{sigmas}]", "name=many", f"results_dir={folder}"]
        yield f"planning {side**2} cells", command("plan", *words), "s"
        experiment = config.load(words)
        store = store_of(experiment)
        store.prepare()
        store.append(*(blank_row(experiment, cell) | {"status": "ok"} for cell in cells(experiment)))
        store.compact()
        yield f"resuming {side**2} stored cells", command("plan", *words), "s"
        yield "python -m bench list", command("list"), "s"
        runs = [
            python("-m", "bench", *SMALL, f"sweep.seed={list(range(n))}", f"name=small{n}", f"results_dir={folder}")[0]
            for n in (1, 1 + count)
        ]
        yield "overhead of a cell", 1e3 * (runs[1] - runs[0]) / count, "ms"


def command(*words):
    """Return the processor seconds of the cheapest of three calls of a command."""
    return min(python("-m", "bench", *words)[0] for _ in range(3))


def python(*words):
    """Return the processor seconds of a Python process and all that it starts, and what it prints."""
    before = sum(os.times()[2:4])
    text = subprocess.run([sys.executable, *words], check=True, capture_output=True, text=True).stdout
    return sum(os.times()[2:4]) - before, text


PARTS = {
    "backends": measure_backends,
    "overhead": measure_overhead,
    "scenes": compare_backends,
    "sweep": measure_sweep,
    "commands": lambda: measure_commands(100, 500),
}


def main(words):
    """Measure, print and write the speeds."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one thread in all libraries, which are imported later
    folder, parts = Path(*words[:1] or ["results/bench_self"]), words[1:]
    for part in ("bench", "plugins"):  # as after a user's first command, also where PYTHONDONTWRITEBYTECODE is set
        compileall.compile_dir(Path(__file__).parents[1] / part, quiet=2)
    path = folder / "bench_self.csv"
    lines = pd.read_csv(path, index_col="what") if parts else pd.DataFrame(columns=["value", "unit"])
    for what, value, unit in itertools.chain.from_iterable(PARTS[part]() for part in parts or PARTS):
        print(f"{what}: {value:.3g} {unit}", flush=True)
        lines.loc[what] = value, unit
    folder.mkdir(parents=True, exist_ok=True)
    lines.to_csv(path, index_label="what")
    (folder / "machine.json").write_text(json.dumps(machine(), indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
