"""Determines which contacts are active in each step of a rollout: the single definition of a contact mode."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from bench.model import (
    Array,
    ContactScene,
    EngineScene,
    ForceLaw,
    Problem,
    Rollout,
    State,
    Unsupported,
)


class EngineContacts(Protocol):
    """The contacts of an engine's model, which only the engine knows, along states ``(T, n, B)``."""

    names: tuple[str, ...]
    """What touches, such as a foot."""

    def touching(self, states: np.ndarray) -> np.ndarray:
        """Return which contacts act in the step from each state, boolean ``(T, n_contacts, B)``."""
        ...

    def gaps(self, states: np.ndarray) -> np.ndarray:
        """Return the distances, negative where a contact acts, ``(T, n_contacts, B)`` [m]."""
        ...

    def forces(self, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return the normal forces at the start of each step, ``(T, n_contacts, B)`` [N]."""
        ...


def engine_contacts(problem: Problem) -> EngineContacts:
    """Return the contacts of an engine's model; raises :class:`Unsupported` for a backend that does not report them.

    A problem that reports them has a method ``engine_contacts()``.
    """
    report = getattr(problem, "engine_contacts", None)
    if report is None:
        raise Unsupported(f"the backend does not report the contacts of scene {problem.program.scene.name}")
    contacts: EngineContacts = report()
    return contacts


def contact_names(problem: Problem) -> tuple[str, ...]:
    """Return the names of a problem's contacts: an engine's own, else numbers from 1, and ``contact`` where there is only one."""
    scene = problem.program.scene
    if isinstance(scene, EngineScene):
        return engine_contacts(problem).names
    count = int(getattr(scene, "n_contacts", 0))
    return tuple(f"contact {i + 1}" for i in range(count)) if count > 1 else ("contact",) * count


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
    before = [scene.split(x) for x in states[:-1]]
    if isinstance(program.contact, ForceLaw):
        return np.stack([scene.gap(np, state.q) < 0 for state in before])
    if forces is None:
        return np.stack(
            [_predicted_contacts(program, scene, state, u) for state, u in zip(before, controls, strict=True)]
        )
    steps = zip(before, states[1:], forces, strict=True)
    return np.stack([_measured_contacts(scene, state, scene.split(x), force) for state, x, force in steps])


def _measured_contacts(scene: ContactScene, before: State, after: State, force: np.ndarray) -> np.ndarray:
    opened = scene.dt**2 * scene.contact(np).response(np, before.q) * force
    return (scene.gap(np, before.q) < 0) | ((force > 0) & (opened > scene.gap(np, after.q)))


def _predicted_contacts(program: Rollout, scene: ContactScene, before: State, u: Array) -> np.ndarray:
    q, v = before
    if program.needs_root:
        free = scene.carried(v) + scene.dt * scene.acceleration(np, q, v, u)
        return scene.gap(np, q + scene.dt * free) < 0
    return (scene.gap(np, q + scene.dt * v) < 0) & (scene.gap_rate(np, q, v) < 0)
