"""Measures time and memory of one rollout and its gradient, on each backend and in native code."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bench.benchself import loop, native
from bench.benchself.lines import SpeedRow
from bench.experiment.by_name import compile_problem
from bench.measure import noise, timing
from bench.model import Problem, blocks, registry

SIZES = (1_000, 10_000, 100_000, 1_000_000)
QUICK_SIZES = (64, 512)
MEMORY_SIZES = SIZES[1:]
SECONDS, CALLS = 1.0, 100
"""Seconds that the timed calls of one line should fill, and a third of the largest number of calls."""
LONGEST = 20.0
"""Seconds per call beyond which larger batches are left out."""
AGREEMENT = 1e-9
"""Largest relative difference allowed for the native gradient."""
NATIVE_COLUMNS = 1024
COMPARED_SIZES = (1_000, 100_000)
CPU = "cpu"
"""The device of a problem that names none."""


def problem(
    settings: Mapping[str, Any], backend: str, contact: str | None, scale: Mapping[str, float] | None = None
) -> Problem:
    """Compile the settings' scene with a contact law or none; ``scale`` multiplies sigma and the law's parameters."""
    scene = registry.make("scenes", settings["scene"], settings["values"])
    law = None if contact is None else registry.make("contacts", contact, settings["contacts"].get(contact))
    if scale:
        scene = replace(scene, sigma=scene.sigma * scale.get("sigma", 1.0))
    if scale and law is not None:
        law = replace(law, **{name: getattr(law, name) * factor for name, factor in scale.items() if name != "sigma"})
    return compile_problem(scene, law, settings["integrator"], backend)


def batch(compiled: Problem, count: int) -> np.ndarray:
    """Return noise ``(n_w, count)``: one draw of at most 10,000 columns, repeated."""
    scene, width = compiled.program.scene.name, compiled.program.n_noise
    drawn = noise.shared(0, scene, 1, min(count, 10_000), width)[0].T
    return np.ascontiguousarray(np.tile(drawn, (1, -(-count // drawn.shape[1])))[:, :count])


def timed(what: str, call: Callable[[], Any], count: int, target: float = float("nan"), note: str = "") -> SpeedRow:
    """Return the microseconds per rollout of a call that makes ``count`` of them."""
    _, clock = timing.timed(lambda _: call()[..., :1].copy(), 3, SECONDS, CALLS)
    return SpeedRow(what, clock.median_s / count * 1e6, "us", target, clock.spread, note)


def backends(settings: Mapping[str, Any], quick: bool) -> Iterator[SpeedRow]:
    """Measure every subject at every batch size, with memory where gradients are fast enough for the largest."""
    found: set[str] = set()
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
        found |= {device} - {CPU}
        for count in QUICK_SIZES if quick else SIZES:
            w = batch(compiled, count)
            call = getattr(compiled, subject["call"])
            name = f"{subject['backend']} {subject['call']}, {subject['contact']}, {count:g} rollouts"
            timing.reset_peak_memory()
            target = subject["target_us"] if count in SIZES else math.nan
            line = timed(name, partial(call, theta, w), count, target, "" if device == CPU else f"on {device}")
            peak = timing.peak_memory_mb() - _own_mb(w, subject["call"] == "grad", compiled.dim)
            yield line
            if count in MEMORY_SIZES:
                yield SpeedRow(
                    f"{name}: peak memory", peak, "MB", note="without the noise given and the result returned"
                )
            if line.value * count * 10e-6 > LONGEST:
                break
    if not found:
        yield SpeedRow("rollouts on an accelerator", math.nan, "us", note="no device: every line is of the processor")


def _own_mb(w: np.ndarray, gradient: bool, dim: int) -> float:
    """Return the memory [MB] of what a caller keeps: noise and result."""
    return float(w.nbytes + w.shape[1] * 8 * (dim if gradient else 1)) / 2**20


def references(settings: Mapping[str, Any], quick: bool) -> Iterator[SpeedRow]:
    """Measure the same gradient in a plain NumPy loop and in native code, checked against the first subject."""
    subject = settings["subjects"][0]
    compiled = problem(settings, subject["backend"], subject["contact"])
    scene: Any = compiled.program.scene
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
    wanted, native_ = compiled.grad(theta, w), kernel(theta, w)
    difference = float(np.abs(native_ - wanted).max() / np.abs(wanted).max())
    yield SpeedRow("native C kernel: largest relative difference", difference, "", AGREEMENT)
    rival = settings["native"]["rival"]
    other = problem(settings, rival, subject["contact"]) if registry.find("backends", rival).available else None
    if other is not None:
        other.threads = 1  # as the loop: two threads may share a core
    for count in sizes:
        w = batch(compiled, count)
        columns = blocks.block_size(count, NATIVE_COLUMNS, native.LANES, 1)

        call = partial(blocks.evaluate, kernel, theta[:, None], w, columns, 1, (compiled.dim,))
        line = timed(f"native C kernel, one thread, {count:g} rollouts", call, count)
        yield line
        if other is not None:
            found = timed("", partial(other.grad, theta, w), count)
            target = settings["native"]["target"] if count in SIZES else math.nan
            share = f"{rival} on one thread over the C kernel, {count:g} rollouts"
            yield SpeedRow(share, found.value / line.value, "", target, found.spread)


def compared(settings: Mapping[str, Any], quick: bool) -> Iterator[SpeedRow]:
    """Measure the gradients of two backends on several scenes, and the time of the second over that of the first."""
    given = settings["compared"]
    missing = [name for name in given["backends"] if not registry.find("backends", name).available]
    if missing:
        yield SpeedRow("gradients of two backends", math.nan, note=f"unavailable: {', '.join(missing)}", unit="")
        return
    for one in given["scenes"][:1] if quick else given["scenes"]:
        own = {**settings, "scene": one["scene"], "values": one.get("values", {})}
        problems = [problem(own, name, one.get("contact")) for name in given["backends"]]
        for count in QUICK_SIZES[:1] if quick else COMPARED_SIZES:
            took = []
            for name, compiled in zip(given["backends"], problems, strict=True):
                call = partial(compiled.grad, compiled.program.theta0, batch(compiled, count))
                call()
                line = timed(f"{name} grad, {one['scene']}, {count:g} rollouts", call, count)
                took.append(line.value)
                yield replace(line, note=f"compiled in {compiled.usage.compile_s:.1f} s")
            share = f"{given['backends'][1]} over {given['backends'][0]}, {one['scene']}, {count:g} rollouts"
            yield SpeedRow(share, took[1] / took[0], "", math.nan if quick else given["target"])
