"""Measures time and memory per rollout and gradient on each backend, in a NumPy loop and in native code."""

import math
from dataclasses import replace
from functools import partial

import numpy as np

from bench.experiment.by_name import compile_problem
from bench.measure import noise, timing
from bench.model import blocks, registry
from speed import loop, native
from speed.speed_rows import SpeedRow

SIZES = (1_000, 10_000, 100_000, 1_000_000)
QUICK_SIZES = (64, 512)
MEMORY_SIZES = SIZES[1:]
SECONDS, CALLS = 1.0, 100
"""Least total time of the timed calls of one row [s], and largest number of repeats of each of its three calls."""
LONGEST = 20.0
"""Time per call [s] above which larger batches are skipped."""
AGREEMENT = 1e-9
"""Largest allowed relative difference between the native gradient and the gradient of the first subject."""
NATIVE_COLUMNS = 1024
COMPARED_SIZES = (1_000, 100_000)
CPU = "cpu"
"""The device of a problem without an attribute ``device``."""


def problem(settings, backend, contact, scale=None):
    """Compile the scene of the settings. ``scale`` has factors for sigma and for parameters of the contact law."""
    scene = registry.make("scenes", settings["scene"], settings["values"])
    law = None if contact is None else registry.make("contacts", contact, settings["contacts"].get(contact))
    if scale:
        scene = replace(scene, sigma=scene.sigma * scale.get("sigma", 1.0))
    if scale and law is not None:
        law = replace(law, **{name: getattr(law, name) * factor for name, factor in scale.items() if name != "sigma"})
    return compile_problem(scene, law, settings["integrator"], backend)


def batch(compiled, count):
    """Return noise ``(n_w, count)``: at most 10,000 random columns, repeated."""
    scene, width = compiled.program.scene.name, compiled.program.n_noise
    drawn = noise.shared(0, scene, 1, min(count, 10_000), width)[0].T
    return np.ascontiguousarray(np.tile(drawn, (1, -(-count // drawn.shape[1])))[:, :count])


def timed(what, call, count, target=float("nan"), note=""):
    """Return the time per rollout [us] of a call that runs ``count`` rollouts."""
    _, clock = timing.timed(lambda _: call()[..., :1].copy(), 3, SECONDS, CALLS)
    return SpeedRow(what, clock.median_s / count * 1e6, "us", target, clock.spread, note)


def measure_backends(settings, quick):
    """Measure the time of every subject at every batch size, and the memory of large batches."""
    devices = set()
    for subject in settings["subjects"]:
        entry = registry.find("backends", subject["backend"])
        if not entry.available:
            yield SpeedRow(
                f"{subject['backend']} {subject['call']}", math.nan, "us", note=f"unavailable: {entry.reason}"
            )
            continue
        compiled = problem(settings, subject["backend"], subject["contact"])
        theta = compiled.program.theta0
        device = str(getattr(compiled, "device", CPU))
        devices |= {device} - {CPU}
        for count in QUICK_SIZES if quick else SIZES:
            w = batch(compiled, count)
            call = getattr(compiled, subject["call"])
            name = f"{subject['backend']} {subject['call']}, {subject['contact']}, {count:g} rollouts"
            timing.reset_peak_memory()
            target = subject["target_us"] if count in SIZES else math.nan
            line = timed(name, partial(call, theta, w), count, target, "" if device == CPU else f"on {device}")
            peak = timing.peak_memory_mb() - _caller_mb(w, subject["call"] == "grad", compiled.dim)
            yield line
            if count in MEMORY_SIZES:
                yield SpeedRow(f"{name}: peak memory", peak, "MB", note="without the noise and the result")
            if line.value * count * 10e-6 > LONGEST:
                break
    if not devices:
        yield SpeedRow("rollouts on an accelerator", math.nan, "us", note="no device: every row is of the processor")


def _caller_mb(w, gradient, dim):
    """Return the memory of the noise and the result, which the caller holds, in MB of 2^20 bytes."""
    return float(w.nbytes + w.shape[1] * 8 * (dim if gradient else 1)) / 2**20


def measure_baselines(settings, quick):
    """Measure the same gradient in a NumPy loop and in native code, which is verified against the first subject."""
    subject = settings["subjects"][0]
    compiled = problem(settings, subject["backend"], subject["contact"])
    scene = compiled.program.scene
    theta = compiled.program.theta0
    sizes = QUICK_SIZES if quick else SIZES
    stiffness = settings["contacts"][subject["contact"]]["stiffness"]
    for count in sizes[:2]:
        call = partial(loop.gradient, scene, stiffness, theta, batch(compiled, count))
        yield timed(f"plain NumPy loop with its adjoint, {count:g} rollouts", call, count)
    try:
        kernel = native.gradient(scene, stiffness)
    except native.Unavailable as error:
        yield SpeedRow("native C kernel", float("nan"), "us", note=f"unavailable: {error}")
        return
    w = batch(compiled, QUICK_SIZES[0])
    expected = compiled.grad(theta, w)
    difference = float(np.abs(kernel(theta, w) - expected).max() / np.abs(expected).max())
    yield SpeedRow("native C kernel: largest relative difference", difference, "", AGREEMENT)
    rival = settings["native"]["rival"]
    other = problem(settings, rival, subject["contact"]) if registry.find("backends", rival).available else None
    if other is not None:
        other.threads = 1  # one thread like the kernel, since two threads may share a core
    for count in sizes:
        w = batch(compiled, count)
        columns = blocks.block_size(count, NATIVE_COLUMNS, native.LANES, 1)

        call = partial(blocks.evaluate, kernel, theta[:, None], w, columns, 1, (compiled.dim,))
        line = timed(f"native C kernel, one thread, {count:g} rollouts", call, count)
        yield line
        if other is not None:
            row = timed("", partial(other.grad, theta, w), count)
            target = settings["native"]["target"] if count in SIZES else math.nan
            share = f"{rival} on one thread over the C kernel, {count:g} rollouts"
            yield SpeedRow(share, row.value / line.value, "", target, row.spread)


def compare_backends(settings, quick):
    """Measure the gradients of two backends on several scenes, and the ratio of the second time to the first."""
    chosen = settings["compared"]
    missing = [name for name in chosen["backends"] if not registry.find("backends", name).available]
    if missing:
        yield SpeedRow("gradients of two backends", math.nan, note=f"unavailable: {', '.join(missing)}", unit="")
        return
    for one in chosen["scenes"][:1] if quick else chosen["scenes"]:
        with_scene = {**settings, "scene": one["scene"], "values": one.get("values", {})}
        problems = [problem(with_scene, name, one.get("contact")) for name in chosen["backends"]]
        for count in QUICK_SIZES[:1] if quick else COMPARED_SIZES:
            times = []
            for name, compiled in zip(chosen["backends"], problems, strict=True):
                call = partial(compiled.grad, compiled.program.theta0, batch(compiled, count))
                call()
                line = timed(f"{name} grad, {one['scene']}, {count:g} rollouts", call, count)
                times.append(line.value)
                yield replace(line, note=f"compiled in {compiled.usage.compile_s:.1f} s")
            share = f"{chosen['backends'][1]} over {chosen['backends'][0]}, {one['scene']}, {count:g} rollouts"
            yield SpeedRow(share, times[1] / times[0], "", math.nan if quick else chosen["target"])
