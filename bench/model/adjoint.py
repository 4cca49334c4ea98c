"""The adjoint of a rollout, step by step. A caller may modify the adjoint between steps, for example to truncate it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bench.model.blocks import OfColumns
from bench.model.manifold import difference, n_changes, retract, slope_by_changes
from bench.model.ops import LoopOps
from bench.model.problem import Jacobians, Problem
from bench.model.program import Rollout, rollout
from bench.model.scene import MechanicalScene

REVISION = 1
"""Raised when a stored number that this module decides moves."""

DIFFERENCE_STEP = 1e-6
"""Step of central differences relative to max(1, |x|), for an error of about 1e-10."""

Cut = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
"""Signature (t, state, adjoint) -> the adjoint ``(k, B)`` to propagate backwards from step t >= 1."""


class Slopes(NamedTuple):
    """Derivatives along B rollouts of T steps.

    n is the length of the state x = (q, v), k of its changes (n unless q is on a manifold), m of the control.
    """

    states: np.ndarray
    """``(T + 1, n, B)``."""
    a: np.ndarray
    """d next state / d state at constant control, ``(T, k, k, B)``."""
    b: np.ndarray
    """d next state / d control, ``(T, k, m, B)``."""
    cost: np.ndarray
    """Stage costs and terminal cost, ``(T + 1, B)``."""
    cost_x: np.ndarray
    """d cost / d state at constant control, ``(T + 1, k, B)``."""
    cost_u: np.ndarray
    """d stage cost / d control, ``(T, m, B)``."""
    feedback_x: np.ndarray | None
    """d feedback / d state, ``(T, m, k, B)``; None without feedback."""
    theta: np.ndarray
    """Theta plus its noise, ``(d, B)``."""


def slopes(problem: Problem, theta: np.ndarray, w: np.ndarray) -> Slopes:
    """Return derivatives along the rollouts of ``theta (d,)`` or ``(d, B)`` under noise ``w (n_w, B)``.

    Step Jacobians are the backend's if it provides them, else central differences of the steps in NumPy. Derivatives of
    costs and feedback are central differences. Raises :class:`Unsupported` for a plain function, and for a step that
    solves an equation if the backend provides no Jacobians.
    """
    program = rollout(problem.program)
    full = _columns(theta, w)
    path = problem.jacobians(full, w) if problem.gives_jacobians else _difference_jacobians(program, full, w)
    return slopes_along(program, path, theta, w)


def slopes_along(program: Rollout, path: Jacobians, theta: np.ndarray, w: np.ndarray) -> Slopes:
    """Return :func:`slopes` from the rollouts and step Jacobians ``path``."""
    full = _columns(theta, w)
    scene, (horizon, m, count) = program.scene, path.controls.shape
    noisy = full if program.action_noise else full + scene.sigma * w[: program.dim]
    before, controls = _flatten(path.states[:-1]), _flatten(path.controls)

    def stage(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(0.0 * x[0] + scene.stage_cost(np, *scene.split(x), u))

    def end(x: np.ndarray) -> np.ndarray:
        return np.asarray(scene.terminal_cost(np, *scene.split(x)))

    def by_state(function: OfColumns, x: np.ndarray) -> np.ndarray:
        if n_changes(scene) == len(x):
            return _central_differences(function, x)
        still = np.zeros((n_changes(scene), x.shape[1]))
        return _central_differences(lambda change: function(retract(scene, np, x, change)), still)

    last = path.states[-1]
    cost = np.concatenate([stage(before, controls).reshape(horizon, count), end(last)[None]])
    by_x = _unflatten(by_state(lambda x: stage(x, controls)[None], before)[0], horizon)
    cost_x = np.concatenate([by_x, by_state(lambda x: end(x)[None], last)])
    cost_u = (
        _unflatten(_central_differences(lambda u: stage(before, u)[None], controls)[0], horizon)
        if m
        else np.zeros((horizon, 0, count))
    )
    is_shared = np.ndim(theta) == 1 and program.action_noise
    feedback_x = _feedback_slopes(scene, path, noisy[:, :1] if is_shared else noisy)
    if feedback_x is None and m and not program.is_open_loop:
        rows = by_state(lambda x: _feedback(program, noisy, x), before)
        feedback_x = np.stack([_unflatten(row, horizon) for row in rows], axis=1)
    return Slopes(path.states, path.a, path.b, cost, cost_x, cost_u, feedback_x, noisy)


def gradient(problem: Problem, path: Slopes, cut: Cut | None = None) -> np.ndarray:
    """Return the gradient of each sample, ``(d, B)``, with the adjoint at each step modified by ``cut`` if given.

    Without ``cut`` the result is the derivative of the cost. The adjoint at step t is the derivative of all costs from
    step t onwards with respect to the state at t.
    """
    return by_theta(problem, path, *by_actions(path, cut))


def by_actions(path: Slopes, cut: Cut | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the cost's derivatives by action ``(T, m, B)``, with later feedback, and by initial state ``(k, B)``."""
    horizon = len(path.a)
    adjoint, by_control = path.cost_x[-1], np.empty_like(path.cost_u)
    for t in range(horizon - 1, -1, -1):
        by_control[t] = path.cost_u[t] + np.einsum("nmb,nb->mb", path.b[t], adjoint)
        adjoint = path.cost_x[t] + np.einsum("ijb,ib->jb", path.a[t], adjoint)
        if path.feedback_x is not None:
            adjoint = adjoint + np.einsum("mnb,mb->nb", path.feedback_x[t], by_control[t])
        if cut is not None and t > 0:
            adjoint = cut(t, path.states[t], adjoint)
    return by_control, adjoint


def by_theta(problem: Problem, path: Slopes, by_control: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
    """Return the gradient ``(d, B)`` from derivatives by action ``(T, m, B)`` and by initial state ``(k, B)``."""
    program = rollout(problem.program)
    scene, first = program.scene, path.states[0]

    def initial(theta: np.ndarray) -> np.ndarray:
        x = np.concatenate(scene.initial_state(np, theta))
        return x if n_changes(scene) == len(first) else difference(scene, np, x, first)

    along = controls_by_theta(program, path.states, path.theta, by_control)
    return np.asarray(along + _theta_differences(initial, path.theta, adjoint))


def controls_by_theta(program: Rollout, states: np.ndarray, theta: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the derivative of sum(weights * controls) by theta along states ``(T + 1, n, B)``, ``(d, B)``."""
    scene = program.scene
    if scene.open_loop:
        each = weights.reshape(scene.controls, -1, *weights.shape[1:])
        result: np.ndarray = each.sum(axis=1).reshape(program.dim, -1)
    else:
        result = _theta_differences(lambda theta: scene.planned_controls(np, theta), theta, weights)
    if program.is_open_loop:
        return result
    x, flat = _flatten(states[:-1]), _flatten(weights)
    along = scene.pullback(theta, np.moveaxis(states[:-1], 1, 0), np.moveaxis(weights, 1, 0))
    by_feedback = (
        _theta_differences(lambda theta: _feedback(program, theta, x), theta, flat) if along is None else along[0]
    )
    return np.asarray(result + by_feedback)


def _feedback_slopes(scene: MechanicalScene, path: Jacobians, theta: np.ndarray) -> np.ndarray | None:
    """Return d feedback / d state, ``(T, m, k, B)``, by the scene's own derivative; None where it has none."""
    states, rows = np.moveaxis(path.states[:-1], 1, 0), []
    for i in range(scene.n_u):
        weights = np.zeros((scene.n_u, *states.shape[1:]))
        weights[i] = 1.0
        along = scene.pullback(theta, states, weights, by_theta=False)
        if along is None:
            return None
        by_change = slope_by_changes(scene, _flatten(path.states[:-1]), along[1].reshape(len(states), -1))
        rows.append(_unflatten(by_change, states.shape[1]))
    return np.stack(rows, axis=1) if rows else None


# ---------------------------------------------------------------------------------------------------- differences


def _difference_jacobians(program: Rollout, theta: np.ndarray, w: np.ndarray) -> Jacobians:
    """Return the step Jacobians, computed by central differences of all steps and columns together."""
    ops = LoopOps()
    with np.errstate(all="ignore"):
        states, controls = program.path(ops, theta, w)
    before, u = _flatten(states[:-1]), _flatten(controls)

    def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.concatenate(program.step(ops, program.scene.split(x), u))

    def by(function: OfColumns, x: np.ndarray) -> np.ndarray:
        return np.stack([_unflatten(row, len(controls)) for row in _central_differences(function, x)], axis=1)

    a = by(lambda x: after(x, u), before)
    b = by(lambda c: after(before, c), u) if len(u) else np.zeros((*a.shape[:2], 0, a.shape[3]))
    return Jacobians(states, controls, a, b)


def _central_differences(function: OfColumns, x: np.ndarray) -> np.ndarray:
    """Return the derivatives ``(k, n, C)`` of ``function: (n, C) -> (k, C)``, column by column."""
    rows = []
    for i in range(len(x)):
        h = DIFFERENCE_STEP * np.maximum(1.0, np.abs(x[i]))
        ahead, behind = x.copy(), x.copy()
        ahead[i] += h
        behind[i] -= h
        rows.append((function(ahead) - function(behind)) / (ahead[i] - behind[i]))
    return np.stack(rows, axis=1)


def _theta_differences(
    function: Callable[[np.ndarray], np.ndarray | None], theta: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Return the derivatives ``(d, B)`` of sum(weight * function(theta)) with respect to each column of theta.

    If the last axis of the function's value is longer than B, the columns of theta repeat along it.
    """
    if function(theta) is None:
        return np.zeros_like(theta)
    steps = DIFFERENCE_STEP * np.maximum(1.0, np.abs(theta))
    if np.array_equal(np.asarray(function(theta + steps)), np.asarray(function(theta - steps))):
        return np.zeros_like(theta)  # the function does not depend on theta: skip the differences by its d coordinates
    result, count = np.empty_like(theta), theta.shape[1]
    for i, h in enumerate(steps):
        ahead, behind = theta.copy(), theta.copy()
        ahead[i] += h
        behind[i] -= h
        change = weight * (np.asarray(function(ahead)) - np.asarray(function(behind)))
        # sum over all axes except the last, then over the repetitions of the columns
        result[i] = change.reshape(-1, change.shape[-1]).sum(axis=0).reshape(-1, count).sum(axis=0) / (2 * h)
    return result


def _columns(theta: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return ``theta (d,)`` or ``(d, B)`` as a column per column of ``w (n_w, B)``."""
    return theta if np.ndim(theta) == 2 else np.repeat(theta[:, None], w.shape[1], axis=1)


def _feedback(program: Rollout, theta: np.ndarray, x: np.ndarray) -> Any:
    """Return the feedback in the states ``x (n, T * B)`` under ``theta (d, B)``, ``(n_u, T * B)``; None without it."""
    return program.scene.feedback(np, np.tile(theta, (1, x.shape[1] // theta.shape[1])), *program.scene.split(x))


def _flatten(values: np.ndarray) -> np.ndarray:
    """Reshape ``(T, n, B)`` to ``(n, T * B)``."""
    return np.moveaxis(values, 1, 0).reshape(values.shape[1], values.shape[0] * values.shape[2])


def _unflatten(values: np.ndarray, steps: int) -> np.ndarray:
    """Reshape ``(n, T * B)`` back to ``(T, n, B)``."""
    return np.moveaxis(values.reshape(len(values), steps, -1), 0, 1)
