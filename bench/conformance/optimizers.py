"""Checks of optimizers on a quadratic bowl with residuals."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.conformance.kit import require, verifies
from bench.conformance.subjects import rng
from bench.model import Answer, Optimizer
from bench.model.optimizer import WANTED

DIM = 4
"""Dimension of the bowl."""
STEPS = 40
"""Number of steps of a checked search."""
TURN = 13
"""Number of steps after which a search is stored and resumed."""

SLOPES = np.diag([0.5, 1.0, 1.5, 2.0]) + 0.1

Watcher = Callable[[int, dict[str, Any], np.ndarray], dict[str, Any]]


def answer(points: np.ndarray, wanted: frozenset[str]) -> Answer:
    """Return the requested fields of the cost |A (theta - goal)|^2 / 2 at points ``(d, B)``."""
    residual = SLOPES @ (points - np.array([[1.0], [-0.5], [0.3], [0.8]]))
    known = {
        "value": 0.5 * (residual**2).sum(axis=0),
        "gradient": SLOPES.T @ residual,
        "residual": residual,
        "jacobian": np.repeat(SLOPES[:, :, None], points.shape[1], axis=2),
    }
    return Answer(**{name: known[name] for name in wanted})


def search(optimizer: Optimizer, watch: Watcher | None = None, steps: int = STEPS) -> tuple[dict[str, Any], list[Any]]:
    """Return the last state of a search that starts at 0, and theta after each step."""
    state, path = optimizer.start(np.zeros(DIM)), []
    for i in range(steps):
        noise = rng("optimizer", i).standard_normal((DIM, optimizer.draws(DIM)))
        noise.setflags(write=False)
        points = optimizer.ask(state, noise)
        require(points.ndim == 2 and points.shape[0] == DIM, f"asks about {points.shape}, not ({DIM}, B)")
        require(np.isfinite(points).all(), f"asks about points that are not finite at step {i}")
        if watch is not None:
            state = watch(i, state, points)
        state = optimizer.tell(state, points, answer(points, optimizer.required_fields(state)))
        require(np.shape(state["theta"]) == (DIM,), f"theta is {np.shape(state['theta'])}, not ({DIM},)")
        path.append(state["theta"])
    return state, path


@verifies(Optimizer)
def needs_are_declared(optimizer: Optimizer) -> str:
    """Verify that the optimizer requests every declared field of an answer at some step, and no other field."""
    wanted: set[str] = set()

    def note(step: int, state: dict[str, Any], points: np.ndarray) -> dict[str, Any]:
        wanted.update(optimizer.required_fields(state))
        return state

    require(optimizer.needs <= WANTED, f"needs {sorted(optimizer.needs - WANTED)}, which an answer does not have")
    search(optimizer, note)
    require(wanted == optimizer.needs, f"requests {sorted(wanted)} and declares {sorted(optimizer.needs)}")
    return ", ".join(sorted(wanted))


@verifies(Optimizer)
def path_repeats_after_a_stop(optimizer: Optimizer) -> str:
    """Verify that a search that is pickled during its run and resumed repeats its path to the last digit."""

    def stopped(step: int, state: dict[str, Any], points: np.ndarray) -> dict[str, Any]:
        return pickle.loads(pickle.dumps(state)) if step == TURN else state

    _, whole = search(optimizer)
    _, resumed = search(optimizer, stopped)
    require(np.array_equal(whole, resumed), f"a search resumed at step {TURN} takes another path")
    return f"{STEPS} steps, resumed at {TURN}"


@verifies(Optimizer)
def state_is_left_alone(optimizer: Optimizer) -> str:
    """Verify that ``ask`` and ``tell`` modify neither state nor points, so that a search can return to a state."""
    before = b""
    kept: dict[str, Any] = {}

    def watch(step: int, state: dict[str, Any], points: np.ndarray) -> dict[str, Any]:
        nonlocal before, kept
        require(pickle.dumps(kept) == before or not before, f"step {step} has changed the state of the step before")
        kept, before = state, pickle.dumps(state)
        points.setflags(write=False)
        return state

    search(optimizer, watch)
    return f"{STEPS} steps"


@verifies(Optimizer)
def descends_on_a_bowl(optimizer: Optimizer) -> str:
    """Verify that the optimizer lowers the cost of a quadratic bowl."""
    state, _ = search(optimizer, steps=4 * STEPS)
    both = np.stack([np.zeros(DIM), state["theta"]], axis=1)
    first, last = map(float, answer(both, frozenset({"value"})).value)
    require(last < first, f"the cost goes from {first:.3g} to {last:.3g} in {4 * STEPS} steps")
    return f"{first:.3g} to {last:.1e} in {4 * STEPS} steps"
