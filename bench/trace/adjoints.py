"""Computes the adjoints of a rollout: the derivatives of its cost by each of its states."""

from __future__ import annotations

import numpy as np

from bench.measure.contacts import split
from bench.model import Array, Jacobians, LoopOps, MechanicalScene, Rollout, State, Unsupported
from bench.model.manifold import difference, n_changes, retract


def adjoints(program: Rollout, theta: np.ndarray, w: np.ndarray, path: Jacobians) -> tuple[np.ndarray, np.ndarray]:
    """Return the adjoints l_k = dL/dx_k of a rollout, ``(T + 1, k)``, and the gradient dL/dtheta from them, ``(d,)``.

    k is the length of changes of a state. ``path`` has no batch axis. With stage costs c_k(x_k, u_k), controls u_k = pi(theta, x_k) and step Jacobians A_k,
    B_k,

        p_k = dc_k/du + B_k' l_{k+1},    l_k = A_k' l_{k+1} + dc_k/dx + (dpi/dx)' p_k,    l_T = dc_T/dx,
        dL/dtheta = (dx_0/dtheta)' l_0 + sum_k (dpi/dtheta)' p_k.

    Where theta contains parameters of the scene, sum_k (dF/dtheta)' l_{k+1} and the derivatives of the costs at fixed x
    and u are added. JAX differentiates costs and policy, with the steps as batch columns, whichever backend computed
    the steps. Source: Griewank and Walther 2008, ch. 3.
    """
    import jax
    import jax.numpy as jnp

    if program.decision.names and program.needs_root:
        raise Unsupported(
            "theta names parameters of steps that solve an equation, which a trace cannot differentiate yet"
        )
    ops = LoopOps(jnp)
    column = jnp.asarray(theta)[:, None]
    before, end = jnp.asarray(path.states[:-1].T), jnp.asarray(path.states[-1:].T)
    count, size = before.shape[1], n_changes(program.scene)
    still = jnp.zeros((size, count))
    taken = jnp.asarray(path.controls.T)

    def first(theta: Array) -> Array:
        bound, theta, noise = program.resolved(ops, theta, w)
        return difference(program.scene, jnp, jnp.concatenate(bound.start(ops, theta, noise)[1]), before[:, :1])

    def at(scene: MechanicalScene, x: Array, change: Array) -> State:
        return split(scene, retract(scene, jnp, x, change))

    def controls(theta: Array, change: Array) -> Array:
        bound, theta, noise = program.resolved(ops, theta, w)
        theta, _, scanned = bound.start(ops, theta, noise)
        slices = tuple(part[:, :, 0].T for part in scanned)
        theta = jnp.broadcast_to(theta, (theta.shape[0], count))
        return bound.control(ops, theta, at(bound.scene, before, change), slices)

    def stage(theta: Array, change: Array, u: Array) -> Array:
        scene = program.resolved(ops, theta, w)[0].scene
        return jnp.sum(jnp.broadcast_to(scene.stage_cost(jnp, *at(scene, before, change), u), count))

    def terminal(theta: Array, change: Array) -> Array:
        scene = program.resolved(ops, theta, w)[0].scene
        return jnp.sum(scene.terminal_cost(jnp, *at(scene, end, change)))

    def along(e: Array) -> Array:
        return jax.jvp(lambda x: controls(column, x), (still,), (jnp.broadcast_to(e[:, None], still.shape),))[1]

    by_state, by_control = (np.asarray(part) for part in jax.grad(stage, (1, 2))(column, still, taken))
    feedback = np.asarray(jax.vmap(along)(jnp.eye(size)))
    adjoint = np.empty((count + 1, size))
    adjoint[count] = np.asarray(jax.grad(terminal, 1)(column, still[:, :1]))[:, 0]
    pulls = np.empty_like(path.controls)
    for k in reversed(range(count)):
        pulls[k] = by_control[:, k] + path.b[k].T @ adjoint[k + 1]
        adjoint[k] = path.a[k].T @ adjoint[k + 1] + by_state[:, k] + feedback[:, :, k] @ pulls[k]
    back = jax.vjp(lambda t: (first(t), controls(t, still)), column)[1]
    gradient = np.asarray(back((jnp.asarray(adjoint[0])[:, None], jnp.asarray(pulls.T)))[0])[:, 0]
    if not program.decision.names:
        return adjoint, gradient

    def at_fixed_states(theta: Array) -> Array:
        bound = program.resolved(ops, theta, w)[0]
        after = jnp.concatenate(bound.step(ops, split(bound.scene, before), taken))
        return jnp.sum(jnp.asarray(adjoint[1:].T) * after) + stage(theta, still, taken) + terminal(theta, still[:, :1])

    return adjoint, gradient + np.asarray(jax.grad(at_fixed_states)(column))[:, 0]
