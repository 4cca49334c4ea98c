"""The adjoint of a rollout step by step: gradients that a caller may cut, and replace by the slope of a value."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench.model.ops import LoopOps, State
from bench.model.problem import Jacobians, Problem
from bench.model.program import Program, Rollout, rollout

DIFFERENCE = 1e-6
"""Step of central differences, relative to the size of a number and at least this: error about 1e-10."""

Cut = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
"""Return the adjoint ``(n, B)`` that goes on backwards from step t >= 1, given t, the state there and its adjoint."""


class Slopes(NamedTuple):
    """Derivatives along rollouts; n states x = (q, v), m controls, B columns."""

    states: np.ndarray
    """``(T + 1, n, B)``."""
    a: np.ndarray
    """Next state by state at fixed control, ``(T, n, n, B)``."""
    b: np.ndarray
    """Next state by control, ``(T, n, m, B)``."""
    cost: np.ndarray
    """Stage costs and the end's, ``(T + 1, B)``."""
    cost_x: np.ndarray
    """Their derivatives by state at fixed control, ``(T + 1, n, B)``."""
    cost_u: np.ndarray
    """Those by control, ``(T, m, B)``."""
    feedback_x: np.ndarray | None
    """Feedback by state, ``(T, m, n, B)``; None without feedback."""
    theta: np.ndarray
    """theta with its noise, ``(d, B)``."""


def slopes(problem: Problem, theta: np.ndarray, w: np.ndarray) -> Slopes:
    """Return derivatives along the rollouts of ``theta (d,)`` under ``w (n_w, B)``.

    Step Jacobians come from the backend where it gives them, else from central differences of the steps in NumPy; those
    of costs and feedback are central differences. Raises :class:`Unsupported` for a plain function, and where a step
    solves an equation that the backend does not differentiate by itself.
    """
    program = rollout(problem.program)
    full = np.repeat(np.reshape(theta, (program.dim, -1)), w.shape[1] if np.ndim(theta) == 1 else 1, axis=1)
    path = (
        problem.jacobians(full, w)
        if type(problem).jacobians is not Problem.jacobians
        else _differenced(program, full, w)
    )
    scene, (horizon, m, count) = program.scene, path.controls.shape
    noisy = full if program.action_noise else full + scene.sigma * w[: program.dim]
    before, controls = _flat(path.states[:-1]), _flat(path.controls)
    repeated = np.tile(noisy, (1, horizon))

    def stage(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return 0.0 * x[0] + scene.stage_cost(np, *_split(program, x), u)

    def end(x: np.ndarray) -> np.ndarray:
        return scene.terminal_cost(np, *_split(program, x))

    def back(x: np.ndarray) -> np.ndarray | None:
        return scene.feedback(np, repeated, *_split(program, x))

    last = path.states[-1]
    cost = np.concatenate([stage(before, controls).reshape(horizon, count), end(last)[None]])
    by_x = _thick(_slope(lambda x: stage(x, controls)[None], before)[0], horizon)
    cost_x = np.concatenate([by_x, _slope(lambda x: end(x)[None], last)])
    cost_u = (
        _thick(_slope(lambda u: stage(before, u)[None], controls)[0], horizon) if m else np.zeros((horizon, 0, count))
    )
    feedback_x = None
    if back(before) is not None:
        feedback_x = np.stack([_thick(row, horizon) for row in _slope(back, before)], axis=1)  # type: ignore[arg-type]
    return Slopes(path.states, path.a, path.b, cost, cost_x, cost_u, feedback_x, noisy)


def gradient(problem: Problem, found: Slopes, cut: Cut | None = None) -> np.ndarray:
    """Return per-sample gradients ``(d, B)``; ``cut`` changes the adjoint on its way backwards, None leaves it.

    Without a cut it is the derivative of the cost. The adjoint of the state at step t is that of all costs from t on.
    """
    return by_theta(problem, found, *by_actions(found, cut))


def by_actions(found: Slopes, cut: Cut | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the cost's derivatives by each step's action ``(T, m, B)``, later feedback included, and by the first state."""
    horizon = len(found.a)
    adjoint, by_control = found.cost_x[-1], np.empty_like(found.cost_u)
    for t in range(horizon - 1, -1, -1):
        by_control[t] = found.cost_u[t] + np.einsum("nmb,nb->mb", found.b[t], adjoint)
        adjoint = found.cost_x[t] + np.einsum("ijb,ib->jb", found.a[t], adjoint)
        if found.feedback_x is not None:
            adjoint = adjoint + np.einsum("mnb,mb->nb", found.feedback_x[t], by_control[t])
        if cut is not None and t > 0:
            adjoint = cut(t, found.states[t], adjoint)
    return by_control, adjoint


def by_theta(problem: Problem, found: Slopes, by_control: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
    """Return ``(d, B)``: derivatives by actions ``(T, m, B)`` and by the first state ``(n, B)``, chained to theta."""
    program = rollout(problem.program)
    scene, horizon = program.scene, len(found.a)
    if scene.open_loop:
        each = by_control.reshape(scene.controls, -1, *by_control.shape[1:])
        result = each.sum(axis=1).reshape(program.dim, -1)
    else:
        result = _by_theta(lambda theta: scene.planned_controls(np, theta), found.theta, by_control)
    x = _flat(found.states[:-1])
    flat = _flat(by_control)

    def back(theta: np.ndarray) -> np.ndarray | None:
        return scene.feedback(np, np.tile(theta, (1, horizon)), *_split(program, x))

    if found.feedback_x is not None:
        result = result + _by_theta(back, found.theta, flat)
    start = _by_theta(lambda theta: np.concatenate(scene.initial_state(np, theta)), found.theta, adjoint)
    return result + start


# ---------------------------------------------------------------------------------------------------- differences


def _differenced(program: Rollout, theta: np.ndarray, w: np.ndarray) -> Jacobians:
    """Return the step Jacobians by central differences of the steps, all steps and columns at once."""
    ops = LoopOps()
    with np.errstate(all="ignore"):
        path = list(program.steps(ops, theta, w))
    states = np.stack([np.concatenate(state) for state, _ in path])
    controls = np.stack([u for _, u in path[:-1]])
    before, u = _flat(states[:-1]), _flat(controls)

    def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.concatenate(program.step(ops, State(*_split(program, x)), u))

    a = np.stack([_thick(row, len(controls)) for row in _slope(lambda x: after(x, u), before)], axis=1)
    if not u.shape[0]:
        return Jacobians(states, controls, a, np.zeros((*a.shape[:2], 0, a.shape[3])))
    b = np.stack([_thick(row, len(controls)) for row in _slope(lambda c: after(before, c), u)], axis=1)
    return Jacobians(states, controls, a, b)


def _slope(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the derivatives ``(k, n, C)`` of ``function: (n, C) -> (k, C)``, column by column."""
    rows = []
    for i in range(len(x)):
        h = DIFFERENCE * np.maximum(1.0, np.abs(x[i]))
        ahead, behind = x.copy(), x.copy()
        ahead[i] += h
        behind[i] -= h
        rows.append((function(ahead) - function(behind)) / (ahead[i] - behind[i]))
    return np.stack(rows, axis=1)


def _by_theta(function: Callable[[np.ndarray], np.ndarray | None], theta: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the derivatives ``(d, B)`` by theta of the sum of weight times ``function(theta)``, column by column.

    The columns of theta repeat along the last axis of the function's value where that is longer.
    """
    if function(theta) is None:
        return np.zeros_like(theta)
    moved = function(theta + DIFFERENCE * np.maximum(1.0, np.abs(theta)))
    back = function(theta - DIFFERENCE * np.maximum(1.0, np.abs(theta)))
    if np.array_equal(np.asarray(moved), np.asarray(back)):
        return np.zeros_like(theta)  # it does not look at theta: no need to go through its d coordinates
    result, count = np.empty_like(theta), theta.shape[1]
    for i in range(len(theta)):
        h = DIFFERENCE * np.maximum(1.0, np.abs(theta[i]))
        ahead, behind = theta.copy(), theta.copy()
        ahead[i] += h
        behind[i] -= h
        change = weight * (np.asarray(function(ahead)) - np.asarray(function(behind)))
        # first the axes before the last, then the repetitions of the columns
        result[i] = change.reshape(-1, change.shape[-1]).sum(axis=0).reshape(-1, count).sum(axis=0) / (2 * h)
    return result


def _split(program: Program, x: np.ndarray) -> State:
    n_q = rollout(program).scene.n_q
    return State(x[:n_q], x[n_q:])


def _flat(values: np.ndarray) -> np.ndarray:
    """Turn ``(T, n, B)`` into ``(n, T * B)``."""
    return np.moveaxis(values, 1, 0).reshape(values.shape[1], values.shape[0] * values.shape[2])


def _thick(values: np.ndarray, steps: int) -> np.ndarray:
    """Turn ``(n, T * B)`` back into ``(T, n, B)``."""
    return np.moveaxis(values.reshape(len(values), steps, -1), 0, 1)
