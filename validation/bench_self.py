"""Measures the speed of the harness, compared with programs written by hand: ``python validation/bench_self.py [FOLDER [PART...]]``.

Writes ``FOLDER/bench_self.json`` (by default in ``results/bench_self``), from which ``docs/speed.md`` is written. With names of
parts, such as ``overhead``, only these are measured, and the other lines of the file stay.
"""

import itertools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from speed import by_hand, loop, native

from bench.experiment import config
from bench.experiment.by_name import compile_problem
from bench.experiment.grid import cells
from bench.measure import noise, timing
from bench.model import Compilations, blocks, registry
from bench.run.execute import store_of
from bench.run.record import machine
from bench.run.tasks import blank_row

SUBJECTS = (
    ("jax", "penalty", "grad"), ("fused", "penalty", "grad"), ("torch", "penalty", "grad"), ("numpy", "penalty", "value"),
    ("implicit", "complementarity", "grad"),
)  # fmt: skip
"""Backend, contact law and method of the rollouts of ``pushing`` that are timed."""
SCENES = ("pushing", "pendulum", "cartpole", "double_pendulum", "hopper", "bounce_once")
"""Scenes whose gradients ``fused`` and ``jax`` are compared on."""
SWEPT = {"stiffness": (500.0, 1e3, 2e3), "beta": (5.0, 10.0, 20.0), "sigma": (0.15, 0.3, 0.6)}
"""Values that differ in no shape, so that they compile nothing anew."""
SIZES = (1_000, 10_000, 100_000, 1_000_000)
SECONDS, CALLS = 1.0, 100
"""Least total time of the timed calls of one row [s], and largest number of repeats of each of its three calls."""
LONGEST = 20.0
"""Time per call [s] above which larger batches are skipped."""
BY_HAND = {
    "jax": ("grad", by_hand.jax_gradient), "torch": ("grad", by_hand.torch_gradient), "numpy": ("value", by_hand.numpy_cost),
}  # fmt: skip
"""Method and program by hand with which a backend is compared."""
SMALL_SIZES = (1, 16, 100, 1_000, 10_000)
LEAST_BLOCK, BLOCKS = 0.02, 31
"""Least processor time of a block of equal calls [s], since its clock is coarse across threads, and the number of pairs of blocks."""
NATIVE_COLUMNS = 1024
SMALL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4")


def problem(backend, contact="penalty", scene="pushing", **values):
    """Compile a scene, ``pushing`` with 100 steps by default; ``values`` are of its law, and ``sigma`` of the scene."""
    made = registry.make("scenes", scene, {"horizon": 100} if scene == "pushing" else {})
    sigma = values.pop("sigma", made.sigma)
    law = registry.make("contacts", contact, values) if getattr(made, "n_contacts", 0) else None
    return compile_problem(replace(made, sigma=sigma), law, "semi_implicit_euler", backend)


def batch(compiled, count):
    """Return noise ``(n_w, count)``: at most 10,000 random columns, repeated."""
    drawn = noise.shared(0, compiled.program.scene.name, 1, min(count, 10_000), compiled.program.n_noise)[0].T
    return np.ascontiguousarray(np.tile(drawn, (1, -(-count // drawn.shape[1])))[:, :count])


def microseconds(call, count):
    """Return the time per rollout [us] of a call that runs ``count`` rollouts."""
    _, clock = timing.timed(lambda _: call()[..., :1].copy(), 3, SECONDS, CALLS)
    return clock.median_s / count * 1e6


def measure_backends():
    """Yield the time of every subject at every batch size, and the peak memory without noise and result."""
    for backend, contact, method in SUBJECTS:
        compiled = problem(backend, contact)
        for count in SIZES:
            w = batch(compiled, count)
            timing.reset_peak_memory()
            each = microseconds(partial(getattr(compiled, method), compiled.program.theta0, w), count)
            given = w.nbytes + 8 * count * (compiled.dim if method == "grad" else 1)
            name = f"{backend} {method}, {contact}, {count:g} rollouts"
            yield name, each, "us"
            yield f"{name}: peak memory", timing.peak_memory_mb() - given / 2**20, "MB"
            if each * count * 10e-6 > LONGEST:
                break


def measure_baselines():
    """Yield the time of the same gradient in a NumPy loop and in native code, which is compared with ``jax``."""
    compiled, rivals = problem("jax"), {name: problem(name) for name in ("fused", "jax")}
    scene, theta = compiled.program.scene, compiled.program.theta0
    stiffness = compiled.program.contact.stiffness
    for count in SIZES[:2]:
        call = partial(loop.gradient, scene, stiffness, theta, batch(compiled, count))
        yield f"plain NumPy loop with its adjoint, {count:g} rollouts", microseconds(call, count), "us"
    kernel = native.gradient(scene, stiffness)
    w = batch(compiled, 64)
    expected = compiled.grad(theta, w)
    difference = np.abs(kernel(theta, w) - expected).max() / np.abs(expected).max()
    yield "native C kernel: largest relative difference", float(difference), ""
    for rival in rivals.values():
        rival.threads = 1  # one thread like the kernel, since two threads may share a core
    for count in SIZES:
        w = batch(compiled, count)
        columns = blocks.block_size(count, NATIVE_COLUMNS, native.LANES, 1)
        call = partial(blocks.evaluate, kernel, theta[:, None], w, columns, 1, (compiled.dim,))
        each = microseconds(call, count)
        yield f"native C kernel, one thread, {count:g} rollouts", each, "us"
        for name, rival in rivals.items():
            ratio = microseconds(partial(rival.grad, theta, w), count) / each
            yield f"{name} on one thread over the C kernel, {count:g} rollouts", ratio, ""


def measure_overhead():
    """Yield the times of backends over those of the same rollouts by hand, in blocks that take turns in this process."""
    for backend, (method, written) in BY_HAND.items():
        compiled = problem(backend)
        theta, call = compiled.program.theta0, getattr(compiled, method)
        hand = written(compiled.program.scene, compiled.program.contact.stiffness)
        for count in SMALL_SIZES:
            w = batch(compiled, count)
            ours, theirs = call(theta, w), hand(theta, w)
            name = f"{backend} {method} over by hand, {count:g} rollouts"
            yield f"{name}: largest relative difference", np.abs(ours - theirs).max() / np.abs(theirs).max(), ""
            ratios = pairs(partial(call, theta, w), partial(hand, theta, w))
            yield f"{name}: processor time", ratios[0], ""
            yield f"{name}: wall time", ratios[1], ""


def pairs(first, second):
    """Return the median ratios of the processor times and of the wall times of two calls."""
    clocks = np.array([[clocked(call) for call in (first, second)] for _ in range(BLOCKS)])
    return np.median(clocks[:, 0] / clocks[:, 1], axis=0)


def clocked(call):
    """Return the processor time of this process and the wall time per call, after a call that is not timed."""
    call()
    count, wall, processor = 0, time.perf_counter(), time.process_time()
    while not count or time.process_time() - processor < LEAST_BLOCK:
        call()
        count += 1
    return (time.process_time() - processor) / count, (time.perf_counter() - wall) / count


def compare_backends():
    """Yield the ratio of the times of gradients by ``fused`` and by ``jax`` on the same cores."""
    for scene, count in itertools.product(SCENES, (1_000, 100_000)):
        problems = [problem(backend, scene=scene) for backend in ("fused", "jax")]
        times = [microseconds(partial(p.grad, p.program.theta0, batch(p, count)), count) for p in problems]
        yield f"fused over jax, {scene}, {count:g} rollouts", times[0] / times[1], ""


def count_compilations():
    """Yield the number of programs that a sweep compiles, and of its distinct shapes."""
    compilations, points = Compilations(), list(itertools.product(*SWEPT.values()))
    for point in points:
        compiled = problem("jax", "softplus", **dict(zip(SWEPT, point, strict=True)))
        compiled.compilations = compilations
        w, theta = batch(compiled, 64), compiled.program.theta0
        compiled.value(theta, w)
        compiled.grad(theta, w)
    what = f"compilations over {len(points)} values of {' x '.join(SWEPT)}"
    yield what, compilations.made, ""
    yield f"{what}: distinct shapes", len(compilations.shapes), ""


def measure_commands(side, count):
    """Yield the times of planning and resuming ``side``^2 cells, of ``list``, and of each of ``count`` small cells."""
    with tempfile.TemporaryDirectory() as folder:
        seeds, sigmas = (",".join(map(str, range(start, start + side))) for start in (0, 1))
        words = [*SMALL, f"sweep.seed=[{seeds}]", f"sweep.sigma=[{sigmas}]", "name=many", f"results_dir={folder}"]
        yield f"planning {side**2} cells", fastest("plan", *words), "s"
        experiment = config.load(words)
        store = store_of(experiment)
        store.prepare()
        store.append(*(blank_row(experiment, cell) | {"status": "ok"} for cell in cells(experiment)))
        store.compact()
        yield f"resuming {side**2} stored cells", fastest("plan", *words), "s"
        before = processor_seconds()
        fastest("list", calls=5)
        yield "python -m bench list", (processor_seconds() - before) / 5, "s"
        seeds = ",".join(map(str, range(count)))
        words = [*SMALL, f"sweep.seed=[{seeds}]", "name=overhead", f"results_dir={folder}"]
        fastest(*words, calls=1)
        rows = store_of(config.load(words)).load().sort_values("stored_at")
        timed = rows[rows["stored_at"] > rows["stored_at"].iloc[0]]
        spent = rows["stored_at"].iloc[-1] - rows["stored_at"].iloc[0] - timed["estimates_s"].sum()
        yield "overhead of a cell", 1e3 * spent / len(timed), "ms"


def fastest(*words, calls=3):
    """Return the seconds of the fastest of several calls of a command: other load only adds time."""
    seconds = []
    for _ in range(calls):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def processor_seconds():
    """Return the processor seconds of all commands so far, with their processes: other load hardly changes them."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


PARTS = {
    "backends": measure_backends, "baselines": measure_baselines, "overhead": measure_overhead, "scenes": compare_backends,
    "compilations": count_compilations, "commands": lambda: measure_commands(100, 500),
}  # fmt: skip


def main(words):
    """Measure, print and write the speeds."""
    folder, parts = Path(*words[:1] or ["results/bench_self"]), words[1:]
    path = folder / "bench_self.json"
    conditions = {"machine": machine(), "load_average_before": os.getloadavg()}
    record = json.loads(path.read_text()) if parts else conditions | {"lines": []}
    lines = {line["what"]: line for line in record["lines"]}
    for what, value, unit in itertools.chain.from_iterable(PARTS[part]() for part in parts or PARTS):
        print(f"{what}: {value:.3g} {unit}", flush=True)
        lines[what] = {"what": what, "value": None if math.isnan(value) else float(value), "unit": unit}
    record |= {part: conditions for part in parts} | {"lines": list(lines.values())}
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
