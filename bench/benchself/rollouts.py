"""Time and memory of one rollout and its gradient, on each backend and in native code."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bench import blocks, noise, registry, timing
from bench.benchself import loop, native
from bench.benchself.lines import Line
from bench.contracts import Problem
from bench.program import Program

SIZES = (1_000, 10_000, 100_000, 1_000_000)
QUICK_SIZES = (64, 512)
MEMORY_SIZES = SIZES[1:]
SECONDS, CALLS = 1.0, 100
"""Seconds that the timed calls of one line should fill, and a third of the most calls."""
LONGEST = 60.0
"""Seconds of a call beyond which larger batches are left out."""
AGREEMENT = 1e-9
"""Largest relative difference of the native gradient."""
NATIVE_COLUMNS = 1024


def problem(
    settings: Mapping[str, Any], backend: str, contact: str, scale: Mapping[str, float] | None = None
) -> Problem:
    """The scene of the settings under a contact law, on a backend; ``scale`` multiplies sigma and the law's parameters."""
    scene = _built("scenes", settings["scene"], settings["values"])
    law = _built("contacts", contact, settings["contacts"].get(contact, {}))
    integrator = _built("integrators", settings["integrator"], {})
    if scale:
        scene = replace(scene, sigma=scene.sigma * scale.get("sigma", 1.0))
        law = replace(law, **{name: getattr(law, name) * factor for name, factor in scale.items() if name != "sigma"})
    made: Problem = _built("backends", backend, {}).compile(Program(scene, law, integrator))
    return made


def _built(kind: str, name: str, values: Mapping[str, Any]) -> Any:
    plugin = registry.find(kind, name).plugin
    assert plugin is not None, f"{kind}: {name}"
    return registry.build(plugin, values)


def batch(made: Problem, count: int) -> np.ndarray:
    """Noise ``(n_w, count)``: one draw of at most 10,000 columns, over and over."""
    scene, width = made.program.scene.name, made.program.n_noise
    drawn = noise.shared(0, scene, 1, min(count, 10_000), width)[0].T
    return np.ascontiguousarray(np.tile(drawn, (1, -(-count // drawn.shape[1])))[:, :count])


def timed(what: str, call: Callable[[], Any], count: int, target: float = float("nan"), note: str = "") -> Line:
    """Microseconds per rollout of a call that makes ``count`` of them."""
    _, clock = timing.timed(lambda _: call()[..., :1].copy(), 3, SECONDS, CALLS)
    return Line(what, clock.median_s / count * 1e6, "us", target, clock.spread, note)


def backends(settings: Mapping[str, Any], quick: bool) -> Iterator[Line]:
    """Every subject at every batch size, with memory where gradients are fast enough for the largest."""
    for subject in settings["subjects"]:
        made = problem(settings, subject["backend"], subject["contact"])
        theta = made.program.scene.theta0()
        for count in QUICK_SIZES if quick else SIZES:
            w = batch(made, count)
            call = getattr(made, subject["call"])
            name = f"{subject['backend']} {subject['call']}, {subject['contact']}, {count:g} rollouts"
            timing.reset_peak_memory()
            line = timed(name, partial(call, theta, w), count, subject["target_us"] if count in SIZES else math.nan)
            peak = timing.peak_memory_mb() - _own_mb(w, subject["call"] == "grad", made.dim)
            yield line
            if count in MEMORY_SIZES:
                yield Line(f"{name}: peak memory", peak, "MB", note="without the noise given and the result returned")
            if line.value * count * 10e-6 > LONGEST:
                break


def _own_mb(w: np.ndarray, gradient: bool, dim: int) -> float:
    """What a caller keeps: noise and result."""
    return (w.nbytes + w.shape[1] * 8 * (dim if gradient else 1)) / 2**20


def references(settings: Mapping[str, Any], quick: bool) -> Iterator[Line]:
    """The same gradient in a plain NumPy loop and in native code, the latter checked against the first subject."""
    subject = settings["subjects"][0]
    made = problem(settings, subject["backend"], subject["contact"])
    scene: Any = made.program.scene
    theta = scene.theta0()
    sizes = QUICK_SIZES if quick else SIZES
    stiffness = settings["contacts"][subject["contact"]]["stiffness"]
    for count in sizes[:2]:
        call = partial(loop.gradient, scene, stiffness, theta, batch(made, count))
        yield timed(f"plain NumPy loop with its adjoint, {count:g} rollouts", call, count)
    try:
        kernel = native.gradient(scene, stiffness)
    except native.Unavailable as error:
        yield Line("native C kernel", float("nan"), "us", note=f"unavailable: {error}")
        return
    w = batch(made, QUICK_SIZES[0])
    wanted, found = made.grad(theta, w), kernel(theta, w)
    difference = float(np.abs(found - wanted).max() / np.abs(wanted).max())
    yield Line("native C kernel: largest relative difference", difference, "", AGREEMENT)
    for count in sizes:
        w = batch(made, count)
        columns = blocks.size(count, NATIVE_COLUMNS, native.LANES, 1)

        call = partial(blocks.evaluate, kernel, theta[:, None], w, columns, 1, (made.dim,))
        yield timed(f"native C kernel, one thread, {count:g} rollouts", call, count)
