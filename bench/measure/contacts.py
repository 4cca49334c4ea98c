"""Determines which contacts are active in each step of a rollout: the single definition of a contact mode."""

from __future__ import annotations

import numpy as np

from bench.model import Array, ContactScene, ForceLaw, MechanicalScene, Rollout, State, Unsupported


def active_contacts(
    program: Rollout, states: np.ndarray, controls: np.ndarray, forces: np.ndarray | None = None
) -> np.ndarray:
    """Return which contacts are active in each step, boolean ``(horizon, n_contacts, B)``.

    ``states (horizon + 1, n, B)`` and ``controls (horizon, n_u, B)`` come from one rollout. Under a force law a contact
    is active where its bodies overlap before the step. Under an impulse law there are two criteria:

    - predicted, without ``forces``: the criterion of the law itself. The bodies approach and would overlap after the
      step. Where the law solves for the end of the step, the bodies would overlap at the end of a step without contact.
      This needs only the state before the step, so many rollouts can be labelled quickly.
    - measured, with ``forces (horizon, n_contacts, B)`` [N], the impulses of the steps over dt: the bodies overlap
      before the step, or the impulse opened the gap by more than the gap after the step, dt^2 (J M^-1 J^T)_ii
      lambda_i > gap_i. On the central path, where forces act at every distance, this means that the bodies would have
      overlapped after a step without contact.

    The two differ for bodies that overlap and already separate: only the measured criterion counts them as a contact.
    Raises :class:`Unsupported` for scenes whose contacts only an engine knows.
    """
    scene = program.scene
    if not isinstance(scene, ContactScene):
        raise Unsupported(f"only the engine knows the contacts of scene {scene.name}")
    before = [split(scene, x) for x in states[:-1]]
    if isinstance(program.contact, ForceLaw):
        return np.stack([scene.gap(np, state.q) < 0 for state in before])
    if forces is None:
        return np.stack(
            [_predicted_contacts(program, scene, state, u) for state, u in zip(before, controls, strict=True)]
        )
    steps = zip(before, states[1:], forces, strict=True)
    return np.stack([_measured_contacts(scene, state, split(scene, x), force) for state, x, force in steps])


def _measured_contacts(scene: ContactScene, before: State, after: State, force: np.ndarray) -> np.ndarray:
    opened = scene.dt**2 * scene.contact(np).response(np, before.q) * force
    return np.asarray((scene.gap(np, before.q) < 0) | ((force > 0) & (opened > scene.gap(np, after.q))))


def _predicted_contacts(program: Rollout, scene: ContactScene, before: State, u: Array) -> np.ndarray:
    q, v = before
    if program.needs_root:
        free = scene.carried(v) + scene.dt * scene.acceleration(np, q, v, u)
        return np.asarray(scene.gap(np, q + scene.dt * free) < 0)
    return np.asarray((scene.gap(np, q + scene.dt * v) < 0) & (scene.gap_rate(np, q, v) < 0))


def split(scene: MechanicalScene, x: Array) -> State:
    """Return the positions and velocities of a state ``x (n, B)`` = (q, v)."""
    return State(x[: scene.n_q], x[scene.n_q :])
