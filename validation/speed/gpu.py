"""Gradients per second of MJX and JAX scenes against the batch, in float32 and float64, on a GPU or the CPU.

    python validation/speed/gpu.py --device cpu --reference    # gradients of a few samples on the CPU, kept beside this file
    python validation/speed/gpu.py --out FOLDER --seconds 500  # the rows: FOLDER/gpu.csv
    python validation/speed/gpu.py --draw FOLDER               # their chart: FOLDER/gpu.png

Each program of one shape compiles in a process of its own, ``--jobs`` at once, and a lock lets one of them use the
device. A row is written as soon as it is measured. Rows come in the order of their worth, and at the end of
``--seconds`` the remaining ones are written as not measured. Required are jax, mujoco, mujoco-mjx, gymnasium's model
files and what ``import bench`` needs, but not hydra.
"""

import argparse
import contextlib
import csv
import fcntl
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
REFERENCE = Path(__file__).with_name("gpu_reference.json")
SCRATCH = Path(os.environ.get("BENCH_GPU_SCRATCH") or tempfile.mkdtemp())
"""Folder of the lock and of marks of processes that compile, shared with the processes of units."""
COLUMNS = (
    "case", "backend", "dtype", "device", "batch", "gradients_per_s", "call_s", "spread", "calls", "with_transfer_s",
    "compile_s", "trace_s", "compiling", "temporary_mib", "peak_mib", "host_mib", "agreement", "finite", "status", "at_s",
)  # fmt: skip
COMPARED, PROJECTIONS = 4, 8
"""Samples whose gradients are compared with the CPU's, and random directions on which they are projected."""
SECONDS, CALLS, LONGEST = 0.5, 20, 15.0
"""Least total time [s] and largest number of a row's timed calls, and the time of a call above which larger batches wait."""
GYMNASIUM = "gymnasium:envs/mujoco/assets"
HUMANOID = '''"""The task of gymnasium's humanoid: run forward (Humanoid-v5, without contact cost and end)."""


def observation(xp, q, v):
    return xp.concat([q[2:], 0.1 * v])


def stage_cost(xp, q, v, u):
    return 0.1 * xp.sum(u * u, axis=0) - 1.25 * v[0]
'''


@dataclass(frozen=True)
class Unit:
    """What one process measures: a case in one precision, at some batches."""

    case: str
    backend: str
    dtype: str
    batches: tuple[int, ...]


ROBOTS = {
    "half_cheetah": (f"mjcf[file={GYMNASIUM}/half_cheetah.xml,horizon=10,substeps=2]", "mjx[iterations=10]"),
    "quadruped": ("mjcf[file=quadruped.xml,horizon=10,substeps=2]", "mjx[iterations=10]"),
    "humanoid": (f"mjcf[file={GYMNASIUM}/humanoid.xml,functions={{humanoid}},horizon=10,substeps=2]", "mjx[iterations=20]"),
}  # fmt: skip
SCENES = ("pushing", "cartpole", "double_pendulum", "hopper")
DTYPES = ("float32", "float64")
BATCHES = (1, 16, 64, 256, 1024, 4096, 16384)


def units(options):
    """Return all units in the order of their worth, with the chosen cases and batches only."""
    robots = [
        Unit(name, ROBOTS[name][1], dtype, (batch,))
        for batch in (1024, 16384, 1, 64, 4096)
        for dtype in DTYPES
        for name in ROBOTS
    ]
    scenes = [Unit(name, "jax", dtype, BATCHES) for name in SCENES for dtype in DTYPES]
    native = [Unit(name, "fused", "float64", BATCHES) for name in SCENES]
    # programs of robots take longest to compile, and the scenes fill the places that remain
    order = [*robots[:6], *scenes, *robots[6:12], *native, *robots[12:]]
    if options.reference:
        order = [
            Unit(name, ROBOTS[name][1] if name in ROBOTS else "jax", "float64", (COMPARED,))
            for name in (*SCENES, *ROBOTS)
        ]
    cases, batches = options.cases.split(","), [COMPARED, *map(int, options.batches.split(","))]
    chosen = [Unit(*key(u), tuple(b for b in u.batches if b in batches)) for u in order if u.case in cases]
    return [unit for unit in chosen if unit.batches]


# --------------------------------------------------------------------------------------------------- one process


def problem(unit):
    """Compile the unit's scene on its backend."""
    from bench.experiment.by_name import compile_problem

    name, _, values = unit.backend.rstrip("]").partition("[")
    values = ",".join(filter(None, [values, f"dtype={unit.dtype}"]))
    scene = ROBOTS[unit.case][0].format(humanoid=SCRATCH / "humanoid.py") if unit.case in ROBOTS else unit.case
    return compile_problem(scene, "penalty", "semi_implicit_euler", f"{name}[{values}]")


def drawn(given, batch):
    """Return noise ``(n_w, batch)``: at most 1,024 random columns, repeated. The first ones are the same in all batches."""
    from bench.measure import noise

    columns = noise.draw(0, "gpu", 1, min(max(batch, COMPARED), 1024), given.program.n_noise, "gpu")[0].T
    return np.ascontiguousarray(np.tile(columns, (1, -(-batch // columns.shape[1])))[:, :batch])


def projected(gradients):
    """Return a few random projections of the first samples' gradients ``(d, B)``."""
    directions = np.random.default_rng(0).standard_normal((PROJECTIONS, len(gradients)))
    return directions @ gradients[:, :COMPARED] / np.sqrt(len(gradients))


def agreement(unit, gradients):
    """Return the largest difference from the CPU's gradients in float64, relative to the largest of them; NaN without them."""
    known = json.loads(REFERENCE.read_text()).get(unit.case) if REFERENCE.is_file() else None
    if known is None:
        return float("nan")
    found = projected(gradients)
    expected = np.array(known)[:, : found.shape[1]]
    return float(np.abs(found - expected).max() / np.abs(expected).max())


@contextlib.contextmanager
def alone():
    """Hold the device: no other process of this program times or writes meanwhile."""
    with open(SCRATCH / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write(folder, row):
    """Append a row and wait until it is on the disk."""
    path = folder / "gpu.csv"
    is_new = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if is_new:
            writer.writeheader()
        writer.writerow({name: f"{value:.4g}" if isinstance(value, float) else value for name, value in row.items()})
        file.flush()
        os.fsync(file.fileno())


def timed(call, seconds=SECONDS):
    """Return the seconds of calls, at least one and at least ``seconds`` in sum if they are short."""
    times = []
    while not times or (len(times) < CALLS and sum(times) < seconds) or (len(times) < 3 and times[0] < LONGEST / 3):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return np.array(times)


def key(unit):
    """Return what names a unit in the rows."""
    return unit.case, unit.backend, unit.dtype


def predecessor(folder, unit, batch):
    """Return the seconds expected of a call, by the largest smaller batch; 0 if none is known or it took below 1 s."""
    if not (folder / "gpu.csv").exists():
        return 0.0
    with open(folder / "gpu.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "ok"]
    known = {
        int(row["batch"]): float(row["call_s"])
        for row in rows
        if (row["case"], row["backend"], row["dtype"]) == key(unit) and int(row["batch"]) < batch
    }
    largest = max(known, default=0)
    return known[largest] * batch / largest if largest and known[largest] > 1.0 else 0.0


def work(unit, folder, began, whole, reference):
    """Measure a unit's rows. With ``whole``, or on a GPU, a batch is one program; else the backend splits it into blocks."""
    import jax

    given = problem(unit)
    if reference:
        gradients = given.grad(given.program.theta0, drawn(given, COMPARED))
        with alone():
            kept = json.loads(REFERENCE.read_text()) if REFERENCE.is_file() else {}
            kept[unit.case] = projected(gradients).tolist()
            lines = [f"{json.dumps(name)}: {json.dumps(rows)}" for name, rows in kept.items()]
            REFERENCE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        return
    platform = "cpu" if unit.backend == "fused" else jax.default_backend()
    whole = unit.backend != "fused" and (whole or platform != "cpu")
    for batch in unit.batches:
        row = dict(zip(COLUMNS, (*key(unit), platform, batch), strict=False))
        try:
            if (expected := predecessor(folder, unit, batch)) > LONGEST:
                raise TimeoutError(f"about {expected:.0f} s per call expected")
            row |= measured(given, unit, batch, whole)
        except Exception as error:
            row |= {"status": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}
        with alone():
            write(folder, row | {"at_s": time.time() - began})


def measured(given, unit, batch, whole):
    """Return the numbers of one batch."""
    import jax

    theta, w = given.program.theta0, drawn(given, batch)
    numbers = {}
    others, mark = len(list(SCRATCH.glob("compiling-*"))), SCRATCH / f"compiling-{os.getpid()}"
    mark.touch()
    try:
        if whole:
            from bench.plugins.backends.compiling import compiled

            arguments = (given._parameters, theta.reshape(-1, 1).astype(given._dtype), w.astype(given._dtype))
            program = compiled((*key(unit), batch), given._cost_gradient, arguments, True, given.compilations)
            numbers |= {"compile_s": sum(program.seconds), "trace_s": program.seconds[0]}
            if analysis := program.call.memory_analysis():
                numbers["temporary_mib"] = analysis.temp_size_in_bytes / 2**20
        else:
            given.reset_usage()
            gradients = given.grad(theta, w)
            numbers |= {"compile_s": given.usage.compile_s, "trace_s": given.usage.trace_s}
    finally:
        mark.unlink()
    with alone():
        if whole:
            gradients = np.asarray(program.call(*arguments), dtype=float)
            placed = jax.device_put(arguments)
            times = timed(lambda: jax.block_until_ready(program.call(*placed)))
            numbers["with_transfer_s"] = np.median(timed(lambda: np.asarray(program.call(*arguments)), SECONDS / 4))
        else:
            times = timed(lambda: given.grad(theta, w))
    middle, low, high = (float(x) for x in np.percentile(times, (50, 25, 75)))
    memory = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in memory:
        numbers["peak_mib"] = memory["peak_bytes_in_use"] / 2**20
    return numbers | {
        "gradients_per_s": batch / middle,
        "call_s": middle,
        "spread": (high - low) / middle,
        "calls": len(times),
        "compiling": others,
        "host_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "agreement": agreement(unit, gradients),
        "finite": float(np.isfinite(gradients).all(axis=0).mean()),
        "status": "ok",
    }


def draw(folder):
    """Draw gradients per second against the batch, a panel per case."""
    import pandas as pd

    from bench.experiment.columns import Column
    from bench.experiment.views import Chart
    from bench.report.draw import draw as drawn_chart
    from bench.report.figures import save, styled

    rows = pd.read_csv(folder / "gpu.csv").query("status == 'ok'")
    about = json.loads((folder / "machine.json").read_text())
    on = rows["device"].map({"gpu": f"one {about['device']}", "cpu": f"fused on {about['cores']} cores"})
    frame = rows.assign(series=rows["dtype"] + ", " + on)
    batch, rate = Column("batch", label="rollouts at once"), Column("gradients_per_s", label="gradients per second")
    chart = Chart("gpu", frame, [batch], [rate], title="How many gradients a second does a GPU compute?", series="series",
                  panel="case")  # fmt: skip
    with styled():
        save(drawn_chart(chart), folder / "gpu")


# ------------------------------------------------------------------------------------------------- all processes


def started(unit, options, began):
    """Start the process of a unit."""
    words = [unit.case, unit.backend, unit.dtype, ",".join(map(str, unit.batches)), str(began)]
    flags = [flag for flag, given in (("--whole", options.whole), ("--reference", options.reference)) if given]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # several processes share the device's memory
        "MUJOCO_GL": "disable",
        "BENCH_GPU_SCRATCH": str(SCRATCH),
    }
    if options.device == "cpu":
        environment["JAX_PLATFORMS"] = "cpu"
    command = [sys.executable, __file__, "--out", str(options.out), *flags, "--unit", *words]
    log = open(options.out / "log.txt", "ab")  # noqa: SIM115, the process writes to it
    return subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)


def machine(options):
    """Return the device and the versions, from a process of its own: this one must hold no memory of the device."""
    code = (
        "import jax, jaxlib, mujoco, numpy, json; d = jax.devices()[0]; print(json.dumps(dict(platform=d.platform,"
        " device=d.device_kind, jax=jax.__version__, jaxlib=jaxlib.__version__, mujoco=mujoco.__version__,"
        " numpy=numpy.__version__)))"
    )
    environment = os.environ | {"MUJOCO_GL": "disable"} | ({"JAX_PLATFORMS": "cpu"} if options.device == "cpu" else {})
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    if done.returncode:
        raise SystemExit(f"JAX or MuJoCo does not start:\n{done.stderr[-2000:]}")
    return {**json.loads(done.stdout.splitlines()[-1]), "cores": os.cpu_count(), "python": sys.version.split()[0]}


def main():
    """Measure all units within the time, or one unit if this is its process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the rows")
    parser.add_argument("--seconds", type=float, default=500.0, help="all rows end by then")
    parser.add_argument("--jobs", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="processes at once")
    parser.add_argument("--batches", default=",".join(map(str, BATCHES)))
    parser.add_argument("--cases", default=",".join((*ROBOTS, *SCENES)))
    parser.add_argument("--whole", action="store_true", help="a batch is one program on the CPU too")
    parser.add_argument("--reference", action="store_true", help=f"write {REFERENCE.name} instead of rows")
    parser.add_argument("--draw", type=Path, help="draw the rows of a folder")
    parser.add_argument("--unit", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.draw:
        draw(options.draw)
        return
    if options.unit:
        case, backend, dtype, batches, began = options.unit
        unit = Unit(case, backend, dtype, tuple(map(int, batches.split(","))))
        work(unit, options.out, float(began), options.whole, options.reference)
        return
    began = time.time()
    options.out = options.out.resolve()
    options.out.mkdir(parents=True, exist_ok=True)
    (SCRATCH / "humanoid.py").write_text(HUMANOID)
    about = machine(options)
    print(about, flush=True)
    (options.out / "machine.json").write_text(json.dumps(about, indent=1) + "\n")
    if about["platform"] == "cpu" and options.device == "gpu":
        raise SystemExit("JAX sees no GPU")
    waiting = units(options)
    running = {}
    try:
        while (waiting or running) and time.time() - began < options.seconds:
            while waiting and len(running) < options.jobs:
                unit = waiting.pop(0)
                running[started(unit, options, began)] = unit
            time.sleep(0.2)
            for process in [p for p in running if p.poll() is not None]:
                unit = running.pop(process)
                print(f"{time.time() - began:6.1f} s  {unit}  exit {process.returncode}", flush=True)
    finally:
        for process, unit in running.items():
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            print(f"{time.time() - began:6.1f} s  {unit}  stopped at the end of the time", flush=True)
        for unit in waiting:
            print(f"          {unit}  not started", flush=True)
        if (options.out / "gpu.csv").exists():
            print((options.out / "gpu.csv").read_text())


if __name__ == "__main__":
    main()
