"""Computes the contact columns of a trace: gaps, forces, active contacts and contact switches at each state."""

from __future__ import annotations

import numpy as np

from bench.experiment.by_name import make
from bench.measure.contacts import active_contacts, contact_names, engine_contacts
from bench.model import (
    ContactScene,
    EngineScene,
    ForceLaw,
    FrictionScene,
    Jacobians,
    LoopOps,
    Problem,
    Rollout,
    compose,
)

REAL = ("gap", "penetration", "force", "force_peak", "sticking", "slipping")
TOUCHES = "touches_"
"""Prefix of the columns of scenes with several contacts: 1 where the contact of that name acts."""


def contact_columns(problem: Problem, program: Rollout, path: Jacobians) -> dict[str, np.ndarray]:
    """Return the columns on contacts, each ``(T + 1,)``; NaN where undefined.

    ``program`` is that of ``problem`` with the parameters of the rollout.
    """
    scene, law = program.scene, program.contact
    count = len(path.states)
    columns = dict.fromkeys(REAL, np.full(count, np.nan))
    columns |= {"contacts": np.zeros(count, dtype=int), "switch": np.zeros(count, dtype=int)}
    if isinstance(scene, EngineScene):
        touching, gap, force = _of_engine(problem, path)
        if not len(gap):
            return columns
    elif law is None or not isinstance(scene, ContactScene):
        return columns
    else:
        state = scene.split(path.states.T)
        gap = scene.gap(np, state.q)
        touching, force = _touching(program, scene, path)
    names, mode = contact_names(problem), touching.astype(int)
    if isinstance(scene, FrictionScene) and scene.friction > 0:
        mode = np.where(touching & (np.abs(scene.slip(np, *state)) > scene.slip_speed), 2, mode)
        columns |= {"sticking": (mode == 1).sum(axis=0), "slipping": (mode == 2).sum(axis=0)}
    total = force.sum(axis=0)
    if len(names) > 1:
        columns |= {f"{TOUCHES}{name}": row.astype(int) for name, row in zip(names, touching, strict=True)}
    return columns | {
        "contacts": touching.sum(axis=0),
        "switch": np.append(0, (mode[:, 1:] != mode[:, :-1]).any(axis=0).astype(int)),
        "gap": gap.min(axis=0),
        "penetration": np.maximum(0.0, -gap).max(axis=0),
        "force": total,
        "force_peak": np.fmax.accumulate(total),
    }


def _of_engine(problem: Problem, path: Jacobians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which contacts of an engine's model act at each state, gaps and normal forces, ``(n_contacts, T + 1)``."""
    contacts = engine_contacts(problem)
    states, controls = path.states[..., None], path.controls[..., None]
    touching, gap = (part[..., 0].T for part in (contacts.touching(states), contacts.gaps(states)))
    force = contacts.forces(states[:-1], controls)[..., 0].T
    return touching, gap, np.append(force, np.full((len(force), 1), np.nan), axis=1)


def _touching(program: Rollout, scene: ContactScene, path: Jacobians) -> tuple[np.ndarray, np.ndarray]:
    """Return which contacts act at each state, and their normal forces [N], both ``(n_contacts, T + 1)``.

    A state has the active contacts of the step that starts there, see :func:`bench.measure.contacts.active_contacts`.
    Under a force law, the force is evaluated at the state. Under an impulse law, the force is the impulse of the step
    over dt, and the contacts are the measured ones. The last state then has the contacts of the last step, and a force
    of NaN.
    """
    law, states, controls = program.contact, path.states[..., None], path.controls[..., None]
    if isinstance(law, ForceLaw):
        state = scene.split(path.states.T)
        gap = scene.gap(np, state.q)
        touching = active_contacts(program, states, controls)[..., 0].T
        force = law.force(np, gap, scene.gap_rate(np, *state)) + 0.0
        return np.append(touching, gap[:, -1:] < 0, axis=1), force
    force = _impulse_forces(program, scene, path)
    touching = active_contacts(program, states, controls, force.T[..., None])[..., 0].T
    nothing = np.full((len(force), 1), np.nan)
    return np.append(touching, touching[:, -1:], axis=1), np.append(force, nothing, axis=1)


def _impulse_forces(program: Rollout, scene: ContactScene, path: Jacobians) -> np.ndarray:
    """Return normal forces ``(n_contacts, T)`` [N] whose impulses explain the difference from a step without the law.

    The forces lambda solve M^-1 J^T lambda dt = v_{k+1} - v_free by least squares, exactly where the normals of the
    contacts are independent.
    """
    q = scene.split(path.states[:-1].T).q
    without_contact = compose(scene, None, program.integrator)
    assert isinstance(without_contact, Rollout)
    jump = scene.split(_stepped(program, path) - _stepped(without_contact, path)).v
    units = np.eye(scene.n_contacts)[:, :, None] + np.zeros((1, 1, q.shape[1]))
    response = np.stack([scene.contact_acceleration(np, q, unit) for unit in units])
    inverse = np.linalg.pinv(np.nan_to_num(response.transpose(2, 1, 0)))
    return (inverse @ jump.T[:, :, None])[:, :, 0].T / scene.dt


def _stepped(program: Rollout, path: Jacobians) -> np.ndarray:
    """Return the state after each step of ``path``, ``(n, T)``, computed with the steps as batch columns."""
    import jax.numpy as jnp

    ops = make("backends", "implicit").ops() if program.needs_root else LoopOps(jnp)
    before, u = jnp.asarray(path.states[:-1].T), jnp.asarray(path.controls.T)
    return np.concatenate([np.asarray(part) for part in program.step(ops, program.scene.split(before), u)])
