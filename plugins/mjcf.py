"""Builds MuJoCo models from scenes' MJCF twins, for backends of MuJoCo's engines, built in or a user's own.

A backend's ``own_refusal`` may call :func:`refusal` and then inspect the model of :func:`build`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.engines.backend import EngineBackend
from bench.model import EngineTwin, MechanicalScene, Program, Unsupported

from .contacts.penalty import Penalty

REVISION = 1
"""Raised when a stored number that this module decides moves."""

MATCH = {"euler": "semi_implicit_euler", "implicitfast": "semi_implicit_euler", "rk4": "rk4"}
"""The integrator of the scene's program that each engine integrator replaces.

``euler`` is the same map. ``implicitfast`` is the same map, except that it evaluates joint and tendon damping at the
end of the step.
"""


def refusal(backend: Any, program: Program) -> str | None:
    """Return why an engine cannot run the program, or None: no twin, another integrator, another contact law.

    The backend has parameters ``integrator``, ``solver``, ``cone``, ``iterations``, ``ls_iterations``, ``lean`` and
    ``impedance``.
    """
    own = backend.integrator
    if reason := EngineBackend.model_refusal(backend.name, program, f" {own}", MATCH[own], ("penalty",), "clipped"):
        return reason
    scene: Any = program.scene
    if (path := scene.model_file()) is None:
        return None
    if backend.impedance != type(backend).impedance:
        return (
            f"contacts of scene {scene.name} are as its file says: impedance={backend.impedance} would have no effect"
        )
    if backend.cone == "pyramidal" and _has_elliptic_cones(path, path.stat().st_mtime_ns):
        return f"{path.name} has elliptic cones: use {backend.name}[cone=elliptic]"
    return None


@cache
def _has_elliptic_cones(path: Path, changed: int) -> bool:
    """Return whether an MJCF file that was last changed at the time ``changed`` has elliptic friction cones."""
    import mujoco

    return bool(mujoco.MjModel.from_xml_path(str(path)).opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC)


def build(backend: Any, program: Program) -> Any:
    """Return the twin as a ``mujoco.MjModel`` with the scene's time step, the law's springs and the backend's solver.

    The model of an MJCF file has its own contacts. Raises :class:`Unsupported` with the reason of :func:`refusal`. The
    backend's own reasons, which may need the model, are not asked for.
    """
    import mujoco

    if reason := refusal(backend, program):
        raise Unsupported(reason)
    scene, law, bit = program.scene, program.contact, mujoco.mjtDisableBit
    assert isinstance(scene, MechanicalScene)
    assert isinstance(scene, EngineTwin)
    path = scene.model_file()
    if path is not None:
        model = mujoco.MjModel.from_xml_path(str(path))
        # steps must depend on the state only, and diverging states must show
        model.opt.disableflags |= int(bit.mjDSBL_WARMSTART | bit.mjDSBL_AUTORESET)
    else:
        model = mujoco.MjModel.from_xml_string(f'<mujoco><option gravity="0 0 0"/>{scene.mjcf()}</mujoco>')
        expected = (scene.n_q, scene.n_v, scene.n_u)
        if (model.nq, model.nv, model.nu) != expected:
            raise ValueError(
                f"the twin of {scene.name} has (n_q, n_v, n_u) = {(model.nq, model.nv, model.nu)}, and the scene {expected}"
            )
        model.opt.disableflags = _disabled(bit, model, backend.lean)
    option = model.opt
    option.timestep = scene.dt / scene.substeps
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{backend.integrator.upper()}")
    option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{backend.solver.upper()}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{backend.cone.upper()}")
    option.iterations, option.ls_iterations = backend.iterations, backend.ls_iterations
    if path is None and isinstance(law, Penalty):
        _set_springs(model, law, backend.impedance)
    return model


def _set_springs(model: Any, law: Penalty, impedance: float) -> None:
    """Set each contact pair's solref and solimp so that its force equals the force of ``law``, for an impedance near 0.

    The engine's acceleration at a contact is a = (1 - d) a_free - (k r + c r') A, with impedance d and inverse mass A
    of the pair: a spring of k [N/m] that cancels the share d of all other forces.
    """
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    inverse_mass = model.body_invweight0[bodies, 0].sum(axis=0)
    inverse_mass *= _cone_factor(model)
    model.pair_solref[:] = -np.array([law.stiffness, law.damping]) * inverse_mass[:, None]
    model.pair_solimp[:, :2] = impedance


def _cone_factor(model: Any) -> Any:
    """Return the factor on each pair's spring that accounts for the edges of its friction cone, ``(n_pairs,)``.

    With a pyramidal cone, a contact with friction is the sum of four edges (two with one direction of friction), each a
    spring with the inverse mass A (1 + mu^2) instead of A. At small impedances, the engine uses 2 mu^2 of this inverse
    mass to regularise an edge, so that the total normal force is 2 / (mu^2 (1 + mu^2)) times the force of one spring
    (MuJoCo, Computation, "Pyramidal cones": R of all edges is one value, derived from the friction coefficients).
    """
    import mujoco

    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return np.ones(model.npair)
    friction = np.maximum(model.pair_friction[:, 0], mujoco.mjMINMU)
    return np.where(model.pair_dim > 1, friction**2 * (1.0 + friction**2) / 2.0, 1.0)


def _disabled(bit: Any, model: Any, lean: bool) -> int:
    """Return the disable flags of features that no twin may use and, with ``lean``, of features that it does not use.

    Steps must depend on the state only (no warm start), damp like the scene (not implicitly), preserve diverging states
    (no reset) and accept any spring (no refsafe).
    """
    off = bit.mjDSBL_WARMSTART | bit.mjDSBL_EULERDAMP | bit.mjDSBL_AUTORESET | bit.mjDSBL_REFSAFE | bit.mjDSBL_CLAMPCTRL
    if not lean:
        return int(off)
    springs = any(part.any() for part in (model.jnt_stiffness, model.tendon_stiffness))
    dampers = any(part.any() for part in (model.dof_damping, model.tendon_damping))
    used = {
        bit.mjDSBL_CONSTRAINT: model.npair,
        bit.mjDSBL_CONTACT: model.npair,
        bit.mjDSBL_GRAVITY: model.opt.gravity.any(),
        # one entry, because MJX disables both features for either flag
        bit.mjDSBL_SPRING | bit.mjDSBL_DAMPER: springs or dampers,
        bit.mjDSBL_ACTUATION: model.nu,
        bit.mjDSBL_EQUALITY: model.neq,
        bit.mjDSBL_LIMIT: model.jnt_limited.any(),
        bit.mjDSBL_FRICTIONLOSS: model.dof_frictionloss.any(),
        bit.mjDSBL_SENSOR: model.nsensor,
        bit.mjDSBL_MIDPHASE: False,
        bit.mjDSBL_ISLAND: False,
    }
    for flag, count in used.items():
        if not count:
            off |= flag
    return int(off)


def mjx_remarks(model: Any) -> list[str]:
    """Return the differences between MJX's physics of a model and the C engine's, by the elements that the model has."""
    import mujoco

    kinds, objects = mujoco.mjtGeom, mujoco.mjtEq
    pairs = [{int(model.geom_type[i]) for i in pair} for pair in _pairs(model)]
    others = {kind for pair in pairs if int(kinds.mjGEOM_PLANE) in pair for kind in pair}
    has_pyramids = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    equalities = set(model.eq_type.tolist())
    found = {
        "boxes and meshes on planes touch only with corners within 1 mm of the deepest": {
            kinds.mjGEOM_BOX,
            kinds.mjGEOM_MESH,
        }
        & others,
        "the friction pyramid of a capsule on a plane is aligned with the world, also where the capsule is not": has_pyramids
        and kinds.mjGEOM_CAPSULE in others,
        "connect and weld lack the velocity product J-dot v": {objects.mjEQ_CONNECT, objects.mjEQ_WELD} & equalities,
    }
    return [f"MJX is not the C engine: {text}" for text, is_so in found.items() if is_so]


class Contacts:
    """The contacts of a model: which pairs of geoms can touch, and where they do, by the C engine's collisions.

    ``names`` has the moving geom of each contact, such as ``front_left``, or both geoms: ``cube-arm``.
    """

    def __init__(self, model: Any) -> None:
        import mujoco

        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._pairs = {pair: i for i, pair in enumerate(_pairs(model))}
        self.names = tuple(_pair_name(model, *pair) for pair in self._pairs)

    def touching(self, states: np.ndarray) -> np.ndarray:
        """Return which contacts act in the step from each state ``(T, n, B)``: boolean ``(T, n_contacts, B)``."""
        result = np.zeros((len(states), len(self._pairs), states.shape[-1]), dtype=bool)
        for t, column in self._placed(states):
            self._mujoco.mj_collision(self._model, self._data)
            for contact, _ in self._active():
                result[t, contact, column] = True
        return result

    def gaps(self, states: np.ndarray) -> np.ndarray:
        """Return the distance at which each contact would act, negative where it does, ``(T, n_contacts, B)`` [m]."""
        result = np.full((len(states), len(self._pairs), states.shape[-1]), np.nan)
        for t, column in self._placed(states):
            for i, pair in enumerate(self._pairs):
                # distance up to which gaps are measured [m]
                result[t, i, column] = self._mujoco.mj_geomDistance(self._model, self._data, *pair, 1e3, None)
        return result

    def forces(self, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return the normal forces at the start of steps from ``(T, n, B)``, ``(T, n_contacts, B)`` [N]."""
        result = np.zeros((len(states), len(self._pairs), states.shape[-1]))
        force = np.zeros(6)
        for t, column in self._placed(states):
            self._data.ctrl[:] = controls[t, :, column]
            self._mujoco.mj_forward(self._model, self._data)
            for contact, i in self._active():
                self._mujoco.mj_contactForce(self._model, self._data, i, force)
                result[t, contact, column] += force[0]
        return result

    def _placed(self, states: np.ndarray) -> Iterator[tuple[int, int]]:
        """Set the simulation data to each state with finite positions, and yield its step and column."""
        for t, column in np.argwhere(np.isfinite(states[:, : self._model.nq]).all(axis=1)).tolist():
            self._data.qpos[:], self._data.qvel[:] = np.split(states[t, :, column], [self._model.nq])
            self._mujoco.mj_kinematics(self._model, self._data)
            yield t, column

    def _active(self) -> list[tuple[int, int]]:
        """Return the contacts that act, each with its number among the engine's, in the simulation data."""
        if not self._data.ncon:
            return []
        contacts = self._data.contact
        is_active = contacts.dist < contacts.includemargin
        pairs = map(tuple, np.sort(contacts.geom).tolist())
        return [(self._pairs[pair], i) for i, pair in enumerate(pairs) if is_active[i] and pair in self._pairs]


def _pairs(model: Any) -> list[tuple[int, int]]:
    """Return the pairs of geoms that can touch: the model's own, and those that its collision filters let through."""
    pairs = [(min(pair), max(pair)) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)]
    welded = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[welded]]
    excluded = set(model.exclude_signature.tolist())
    meets = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
    for a, b in np.argwhere(np.triu(meets | meets.T, 1)).tolist():
        is_joined = welded[a] and welded[b] and (parent[a] == welded[b] or parent[b] == welded[a])
        low, high = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
        if welded[a] != welded[b] and not is_joined and (low << 16) + high not in excluded:
            pairs.append((a, b))
    return list(dict.fromkeys(pairs))


def _pair_name(model: Any, a: int, b: int) -> str:
    """Return the names of a pair's geoms, without a geom that is fixed to the world."""
    moving = [i for i in (a, b) if model.body_weldid[model.geom_bodyid[i]]] or [a, b]
    return "-".join(model.geom(i).name or f"{model.body(model.geom_bodyid[i]).name or 'body'}.{i}" for i in moving)
