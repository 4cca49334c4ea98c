"""Runs one training: updates, evaluations on the way, comparisons of gradients, and the log."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.measure.performance import Z
from bench.measure.statistics import Sampling, bias_interval, ends
from bench.model import Trainer
from bench.model.trainer import LOGGED
from bench.training.environment import Environment
from bench.training.run import Training

from . import Train
from .verdicts import FINITE

MEANS = frozenset({"loss", "reward", "value_loss", "cut", "used", "contacts", "step_length", "deviation"})
"""Quantities whose mean an entry of a stored log has; it has the largest value of the others, so that no peak is lost."""
LENGTHS = (1e-6, 1e-7, 1e-8)
"""Changes of parameters in central differences in float64, short enough for episodes with contact."""


def measure(cell: Cell, session: Session, settings: Train) -> dict[str, Any]:
    """Return one cell's results by column."""
    trainer, backend = cell.parts["trainer"], cell.backend
    assert isinstance(trainer, Trainer)
    training = _training(cell, backend)
    env = training.env
    # all trainers and seeds are evaluated from the same starts
    starts = noise.draw(0, cell.scene.name, 1, settings.starts, env.n_start, "train: starts")[0].T
    total, per_update = trainer.updates(env), trainer.steps_per_update(env)
    marks = set(np.unique(np.linspace(0, total, min(settings.evaluations, total) + 1).round().astype(int)).tolist())
    checks = _spread(total, settings.cosines) if trainer.first_order else set()
    halfway = max(total // 2, 1) if trainer.first_order else -1

    state = training.start(cell.seed)
    training.returns(state, starts)
    training.compile_update(state)
    compile_s = training.compile_s
    curve: list[tuple[float, ...]] = []
    cosines: list[tuple[float, float, float]] = []
    log: list[dict[str, float]] = []
    bad: tuple[int, str] | None = None
    probe: dict[str, Any] = {}
    spent = 0.0
    for update in range(total + 1):
        if update in marks or update == total:
            bad = _first_not_finite(log)
            curve.append((update, update * per_update, spent, *_interval(training.returns(state, starts))))
            if bad is not None or update == total:
                break
        if update in checks:
            agreement = training.agreement(state, update + 1, settings.copies)
            cosines.append((update, agreement["cosine"], agreement["cosine_denoised"]))
        if update == halfway:
            exact = _training(cell, dataclasses.replace(backend, dtype="float64"))
            probe = {"slope_errors": slope_errors(exact, state), **_windows(training, state, settings.batches)}
        started = time.perf_counter()
        state, entry = jax.block_until_ready(training.update(state))
        spent += time.perf_counter() - started
        log.append({name: float(value) for name, value in entry.items()})

    table, stored = np.array(curve), ("update", "step", "s", "return", "return_low", "return_high")
    final = table[-1, 3:]
    norms = _column(log, "gradient_norm")
    return {
        "status": "ok" if bad is None else "nonfinite",
        "reason": "" if bad is None else f"{bad[1]} is not finite at update {bad[0]}",
        "first_return": table[0, 3],
        **ends("final_return", final[:3]),
        "final_median": final[3],
        "updates": int(table[-1, 0]),
        "steps": int(table[-1, 1]),
        "train_s": spent,
        "compile_s": compile_s,
        "gradient_typical": float(np.nanmedian(norms)),
        "gradient_peak": float(np.nanmax(norms)),
        "gradient_zero": float((norms == 0).mean()),
        **probe,
        **{f"curve_{name}": table[:, i].tolist() for i, name in enumerate(stored)},
        **{name: [row[i] for row in cosines] for i, name in enumerate(("cosine_update", "cosine", "cosine_denoised"))},
        **_thinned(log, settings.entries),
    }


def _training(cell: Cell, backend: Any) -> Training:
    """Return a cell's trainer on its environment, in the precision of a backend."""
    env = Environment(backend.compile(cell.program()).program, backend.ops(), backend.dtype)
    return Training(env, cell.parts["trainer"])  # type: ignore[arg-type]


def _first_not_finite(log: list[dict[str, float]]) -> tuple[int, str] | None:
    """Return the first update with a quantity that has to be finite and is not, and the quantity; None without one."""
    bad = ((i, name) for i, entry in enumerate(log, 1) for name in FINITE if not math.isfinite(entry.get(name, 0.0)))
    return next(((update, name.replace("_", " ")) for update, name in bad), None)


def _column(log: list[dict[str, float]], name: str) -> np.ndarray:
    """Return one quantity by update, ``(n,)``; NaN where a trainer does not have it."""
    return np.array([entry.get(name, math.nan) for entry in log])


def _spread(total: int, count: int) -> set[int]:
    """Return ``count`` updates spread over a run, in the middles of equal parts."""
    return {int(total * (i + 0.5) / count) for i in range(count)} if count else set()


def _interval(returns: np.ndarray) -> tuple[float, float, float, float]:
    """Return mean, ends of its 95% interval, and median of returns ``(B,)``."""
    mean, half = float(returns.mean()), Z * float(returns.std(ddof=1)) / math.sqrt(len(returns))
    return mean, mean - half, mean + half, float(np.median(returns))


def slope_errors(exact: Training, state: Any) -> list[float]:
    """Return the relative error of the gradient along which an update moves the actor, by array, in float64.

    The error is that of its slope along a random direction of signs in that array, against central differences of the update's
    own loss, with the same noise. Slopes are in units of their median over arrays: Adam does not depend on a common factor. NaN
    where differences of three lengths do not agree, so that the slope is not known; empty for an optimizer other than Adam.
    """
    if optax.tree.get(state.memory, "mu") is None:
        return []
    state = jax.tree.map(lambda x: x.astype("float64") if jnp.issubdtype(x.dtype, jnp.floating) else x, state)
    gradient = exact.applied(state)
    sizes = [leaf.size for leaf in jax.tree.leaves(state.actor)]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], gradient.size)
    ratios = []
    for array in np.split(np.arange(gradient.size), np.cumsum(sizes)[:-1]):
        direction = np.zeros_like(gradient)
        direction[array] = signs[array]
        slopes = np.array(
            [(exact.loss(state, h * direction) - exact.loss(state, -h * direction)) / (2 * h) for h in LENGTHS]
        )
        # a slope is known if the three differences agree to 1%
        is_known = np.ptp(slopes) < 0.01 * abs(slopes[1])
        ratios.append(float(gradient @ direction / slopes[1]) if is_known else math.nan)
    common = abs(np.nanmedian(ratios)) if np.isfinite(ratios).any() else math.nan
    return [abs(ratio / common - 1.0) for ratio in ratios]


def _windows(training: Training, state: Any, batches: int) -> dict[str, Any]:
    """Return the bias of windows at one state of a run; empty for a trainer without windows.

    The gradient of whole episodes is computed without cuts, and cut into the trainer's windows, each of which ends in the
    critic's value: without the critic's error and the cuts, both would be equal. ``window_bias`` is the distance of their
    means, relative to the gradient without cuts, with the interval of :func:`bias_interval`. Both have the same noise.
    """
    result: dict[str, Any] = {}
    if batches > 1 and hasattr(training.trainer, "window"):
        length, every = training.env.length, training.trainer.window
        whole = np.array([training.gradient(state, 1 + i, length) for i in range(batches)])
        window = np.array([training.gradient(state, 1 + i, length, every) for i in range(batches)])
        result["window_gradient"] = float(np.linalg.norm(window.mean(axis=0)))
        scale = float(np.linalg.norm(whole.mean(axis=0)))
        if np.isfinite(window).all() and np.isfinite(whole).all() and scale > 0:
            difference = window - whole
            bias = bias_interval(difference.mean(axis=0), Sampling.of(difference))
            result |= ends("window_bias", (value / scale for value in bias))
    return result


def _thinned(log: list[dict[str, float]], entries: int) -> dict[str, list[float]]:
    """Return the log in at most ``entries`` entries per quantity, with five significant digits."""
    count = len(log)
    edges = np.unique(np.linspace(0, count, min(entries, count) + 1).round().astype(int))
    result = {"log_update": edges[1:].tolist()}
    for name in LOGGED:
        values = _column(log, name)
        if np.isnan(values).all():
            continue
        parts = [values[a:b] for a, b in itertools.pairwise(edges)]
        reduced = [part.mean() if name in MEANS else part.max() for part in parts]
        result[f"log_{name}"] = [float(f"{value:.5g}") for value in reduced]
    return result
