"""Gradients per second of MJX and JAX scenes against the batch, in float32 and float64, on a GPU or the CPU.

    python validation/speed/gpu.py --out FOLDER --seconds 500  # the rows: FOLDER/gpu.csv
    python validation/speed/gpu.py --draw FOLDER               # their chart: FOLDER/gpu.png

Programs compile in processes of their own, ``--jobs`` at once, and a lock lets one of them use the device. A row is written
as soon as it is measured. Rows come in the order of their worth, until ``--seconds`` have passed. Required are jax, mujoco,
mujoco-mjx, gymnasium's model files and what ``import bench`` needs, but not hydra.
"""

import argparse
import json
import multiprocessing
import os
import platform
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

REFERENCE = Path(__file__).with_name("gpu_reference.json")
COLUMNS = (
    "case",
    "backend",
    "dtype",
    "device",
    "batch",
    "gradients_per_s",
    "call_s",
    "spread",
    "calls",
    "with_transfer_s",
    "compile_s",
    "agreement",
    "finite",
    "status",
    "at_s",
)
COMPARED, PROJECTIONS = 4, 8
"""Samples whose gradients are compared with the CPU's, and random directions on which they are projected."""
SECONDS, CALLS = 0.5, 20
"""Least total time [s] and largest number of a row's timed calls."""
GYMNASIUM = "gymnasium:envs/mujoco/assets"
RUN = '''"""A task of gymnasium: run forward (Ant-v5, Humanoid-v5), without contact cost and end."""


def observation(xp, q, v):
    return xp.concat([q[2:], 0.1 * v])


def stage_cost(xp, q, v, u):
    return {effort} * xp.sum(u * u, axis=0) - {speed} * v[0]
'''


class Unit(NamedTuple):
    """What one process measures: a case in one precision, at some batches."""

    case: str
    backend: str
    dtype: str
    batches: tuple[int, ...]


ROBOTS = {
    "half_cheetah": (f"mjcf[file={GYMNASIUM}/half_cheetah.xml,horizon=10,substeps=2]", "mjx[iterations=10]"),
    "ant": (f"mjcf[file={GYMNASIUM}/ant.xml,functions={{folder}}/ant.py,horizon=10,substeps=2]", "mjx[iterations=10]"),
    "quadruped": ("mjcf[file=quadruped.xml,horizon=10,substeps=2]", "mjx[iterations=10]"),
    "humanoid": (
        f"mjcf[file={GYMNASIUM}/humanoid.xml,functions={{folder}}/humanoid.py,horizon=10,substeps=2]",
        "mjx[iterations=20]",
    ),
}
SCENES = ("pushing", "cartpole", "double_pendulum", "hopper")
DTYPES = ("float32", "float64")
BATCHES = (1, 16, 64, 256, 1024, 4096, 16384)


def units(options):
    """Return all units in the order of their worth, with the chosen cases and batches only."""
    robots = [
        Unit(name, ROBOTS[name][1], dtype, (batch,))
        for batch in (1024, 16384, 1, 16, 64, 4096)
        for dtype in DTYPES
        for name in ROBOTS
    ]
    scenes = [Unit(name, "jax", dtype, BATCHES) for name in SCENES for dtype in DTYPES]
    native = [Unit(name, "fused", "float64", BATCHES) for name in SCENES]
    # programs of robots take longest to compile, and the scenes fill the places that remain
    order = [*robots[:8], *scenes, *robots[8:16], *native, *robots[16:]]
    cases, batches = options.cases.split(","), [*map(int, options.batches.split(","))]
    chosen = [Unit(*u[:3], tuple(b for b in u.batches if b in batches)) for u in order if u.case in cases]
    return [unit for unit in chosen if unit.batches]


# --------------------------------------------------------------------------------------------------- one process


def problem(unit, folder):
    """Compile the unit's scene on its backend; ``folder`` has the tasks of the ant and the humanoid."""
    from bench.experiment.by_name import compile_problem

    name, _, values = unit.backend.rstrip("]").partition("[")
    values = ",".join(filter(None, [values, f"dtype={unit.dtype}"]))
    scene = ROBOTS.get(unit.case, (unit.case,))[0].format(folder=folder)
    return compile_problem(scene, "penalty", "semi_implicit_euler", f"{name}[{values}]")


def drawn(given, batch):
    """Return noise ``(n_w, batch)``: at most 1,024 random columns, repeated. The first ones are the same in all batches."""
    from bench.measure import noise

    columns = noise.draw(0, "gpu", 1, min(max(batch, COMPARED), 1024), given.program.n_noise, "gpu")[0].T
    return np.ascontiguousarray(np.tile(columns, (1, -(-batch // columns.shape[1])))[:, :batch])


def agreement(unit, gradients):
    """Return the largest difference from the CPU's gradients in float64, relative to the largest of them.

    Compared are a few random projections of the first samples' gradients ``(d, B)``.
    """
    directions = np.random.default_rng(0).standard_normal((PROJECTIONS, len(gradients)))
    found = directions @ gradients[:, :COMPARED] / np.sqrt(len(gradients))
    expected = np.array(json.loads(REFERENCE.read_text())[unit.case])[:, : found.shape[1]]
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def timed(call, seconds=SECONDS):
    """Return the seconds of calls, at least one and at least ``seconds`` in sum if they are short."""
    times = []
    while not times or (len(times) < CALLS and sum(times) < seconds):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return np.array(times)


def work(unit, options, lock, began):
    """Measure a unit's rows. On a GPU a batch is one program; else the backend splits it into blocks."""
    import jax

    given = problem(unit, options.out)
    device = "cpu" if unit.backend == "fused" else jax.default_backend()
    whole = device != "cpu"
    for batch in unit.batches:
        row = dict(zip(COLUMNS, (*unit[:3], device, batch), strict=False))
        try:
            row |= measured(given, unit, batch, whole, lock)
        except Exception as error:
            row |= {"status": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}
        table, row = options.out / "gpu.csv", pd.DataFrame([row | {"at_s": time.time() - began}], columns=COLUMNS)
        with lock:
            row.to_csv(table, mode="a", header=not table.exists(), index=False, float_format="%.4g")


def measured(given, unit, batch, whole, lock):
    """Return the numbers of one batch."""
    import jax

    theta, w = given.program.theta0, drawn(given, batch)
    if whole:
        from bench.plugins.backends.compiling import compiled

        arguments = (given._parameters, theta.reshape(-1, 1).astype(given._dtype), w.astype(given._dtype))
        program = compiled((*unit[:3], batch), given._cost_gradient, arguments, True, given.compilations)
        numbers = {"compile_s": sum(program.seconds)}
    else:
        given.reset_usage()
        gradients = given.grad(theta, w)
        numbers = {"compile_s": given.usage.compile_s}
    with lock:
        if whole:
            gradients = np.asarray(program.call(*arguments), dtype=float)
            placed = jax.device_put(arguments)
            times = timed(lambda: jax.block_until_ready(program.call(*placed)))
            numbers["with_transfer_s"] = np.median(timed(lambda: np.asarray(program.call(*arguments)), SECONDS / 4))
        else:
            times = timed(lambda: given.grad(theta, w))
    middle, low, high = (float(x) for x in np.percentile(times, (50, 25, 75)))
    return numbers | {
        "gradients_per_s": batch / middle,
        "call_s": middle,
        "spread": (high - low) / middle,
        "calls": len(times),
        "agreement": agreement(unit, gradients),
        "finite": float(np.isfinite(gradients).all(axis=0).mean()),
        "status": "ok",
    }


def draw(folder):
    """Draw gradients per second against the batch, a panel per case."""
    from bench.experiment.columns import Column
    from bench.experiment.views import Chart
    from bench.report.draw import draw as drawn_chart
    from bench.report.figures import save, styled

    rows = pd.read_csv(folder / "gpu.csv").query("status == 'ok'")
    about = json.loads((folder / "machine.json").read_text())
    on = rows["device"].map({"gpu": f"one {about['device']}", "cpu": f"fused on {about['cores']} cores"})
    frame = rows.assign(series=rows["dtype"] + ", " + on)
    batch, rate = Column("batch", label="rollouts at once"), Column("gradients_per_s", label="gradients per second")
    chart = Chart(
        "gpu",
        frame,
        [batch],
        [rate],
        title="How many gradients a second does a GPU compute?",
        series="series",
        panel="case",
    )
    with styled():
        save(drawn_chart(chart), folder / "gpu")


# ------------------------------------------------------------------------------------------------- all processes


def machine():
    """Return the device and the versions."""
    import jax
    import jaxlib
    import mujoco

    device, libraries = jax.devices()[0], (jax, jaxlib, mujoco, np)
    return {
        "platform": device.platform,
        "device": device.device_kind,
        **{each.__name__: each.__version__ for each in libraries},
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def main():
    """Measure all units within the time, or one unit if this is its process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the rows")
    parser.add_argument("--seconds", type=float, default=500.0, help="all rows end by then")
    parser.add_argument("--jobs", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="processes at once")
    parser.add_argument("--batches", default=",".join(map(str, BATCHES)))
    parser.add_argument("--cases", default=",".join((*ROBOTS, *SCENES)))
    parser.add_argument("--draw", type=Path, help="draw the rows of a folder")
    options = parser.parse_args()
    if options.draw:
        draw(options.draw)
        return
    began, options.out = time.time(), options.out.resolve()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "ant.py").write_text(RUN.format(effort=0.5, speed=1.0))
    (options.out / "humanoid.py").write_text(RUN.format(effort=0.1, speed=1.25))
    os.environ |= {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "MUJOCO_GL": "disable"}  # the processes share the memory
    os.environ |= {"JAX_PLATFORMS": "cpu"} if options.device == "cpu" else {}
    sys.path.append(
        str(Path(__file__).parents[2])
    )  # processes have the same path, so the package need not be installed
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:  # a process of its own, since this one must hold no memory of the device
        about = pool.apply(machine)
    print(about, flush=True)
    (options.out / "machine.json").write_text(json.dumps(about, indent=1) + "\n")
    if about["platform"] == "cpu" and options.device == "gpu":
        raise SystemExit("JAX sees no GPU")
    with context.Manager() as manager, context.Pool(options.jobs, maxtasksperchild=1) as pool:
        lock = manager.Lock()
        results = [(unit, pool.apply_async(work, (unit, options, lock, began))) for unit in units(options)]
        for unit, result in results:
            result.wait(max(0.0, began + options.seconds - time.time()))
            print(unit, "done" if result.ready() else "not done in the time", flush=True)
    print((options.out / "gpu.csv").read_text() if (options.out / "gpu.csv").exists() else "")


if __name__ == "__main__":
    main()
