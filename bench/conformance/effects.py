"""Checks that each float parameter of a scene or contact law moves costs, or is declared to have no effect."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np

from bench.conformance.kit import require, skip_unless, verifies
from bench.conformance.subjects import NewtonOps, law_for, rng, sound_laws, sound_scenes, stepping
from bench.errors import UserError
from bench.host.parameters import traced
from bench.model import (
    CallableScene,
    ContactLaw,
    EngineScene,
    FrictionScene,
    Integrator,
    MechanicalScene,
    Scene,
    compose,
)

N_COLUMNS = 16
"""Thetas, each with its noise, at which costs are compared."""


@verifies(Scene)
def parameters_have_an_effect(scene: Scene) -> str:
    """Verify that each parameter moves costs under some kind of law, and that no parameter declared without effect does."""
    skip_unless(not isinstance(scene, CallableScene | EngineScene), "its costs are computed outside the program")
    laws: dict[Any, ContactLaw | None] = {None: None}
    if isinstance(scene, MechanicalScene) and scene.n_contacts:
        explicit = [law for law in sound_laws() if not law.needs_root]
        laws = {law.ignores: law_for(scene, law) for law in reversed(explicit)}
    idle: dict[str, set[str]] = {}
    for law in laws.values():
        moving, declared = _moving(scene, law, "scene"), set(scene.without_effect(law))
        _require_idle(moving & declared, " + ".join(part.name for part in (scene, law) if part is not None))
        idle[law.name if law else "any law"] = set(traced(scene)) - moving - declared - {"sigma"}
    _require_none(set.intersection(*idle.values()), scene.name)
    return (
        "; ".join(f"no effect under {law}: {', '.join(sorted(names))}" for law, names in idle.items() if names) or "all"
    )


@verifies(ContactLaw)
def ignored_parameters_are_declared(law: ContactLaw) -> str:
    """Verify that the law's parameters move costs, and the scene's contact parameters do unless the law ignores them."""
    scenes = [s for s in sound_scenes() if isinstance(s, FrictionScene) and not isinstance(s, EngineScene)]
    # steps of the rollouts in which a law is checked
    scenes = [dataclasses.replace(scene, horizon=min(scene.horizon, 20)) for scene in scenes]
    skip_unless(scenes, "no scene with friction is registered")
    own = set() if law.surrogate else set(traced(law))  # a surrogate's parameters may move gradients only
    contact = {"friction", "slip_speed", "restitution"}
    moving = {name for s in scenes for axis in ("scene", "contact") for name in _moving(s, law_for(s, type(law)), axis)}
    _require_none((own | contact) - moving - set(law.ignores), law.name)
    _require_idle(moving & set(law.ignores), law.name)
    return f"{len(own)} parameters, {len(scenes)} scenes with friction"


def _require_none(idle: set[str], where: str) -> None:
    names = ", ".join(sorted(idle))
    require(not idle, f"{where}: {names} without effect: declare it in `without_effect`, or in `ignores` of the law")


def _require_idle(wrong: set[str], where: str) -> None:
    require(not wrong, f"{where}: {', '.join(sorted(wrong))} declared without effect, and costs depend on it")


def _moving(scene: Scene, law: ContactLaw | None, axis: str) -> set[str]:
    """Return the parameters of ``scene`` or ``contact`` that move theta0 or a cost near the defaults, at several thetas."""
    draw = rng("effects", scene.name)
    given = {"scene": scene, "contact": law}
    # largest relative distance of the parameters from their defaults: a body may start in balance, where a
    # damper is idle
    near: dict[str, Any] = {
        name: part and _with(part, {n: getattr(part, n) * (1 + 0.1 * draw.uniform(-1, 1)) for n in traced(part)})
        for name, part in given.items()
    }
    theta, own = near["scene"].theta0(), compose(near["scene"], near["contact"], _integrator(scene))
    apart = 0.3 * (1.0 + np.abs(theta[:, None])) * draw.standard_normal((theta.size, N_COLUMNS))
    apart[:, 0] = 0.0
    w = draw.standard_normal((own.n_noise, N_COLUMNS))

    def costs(parts: dict[str, Any]) -> np.ndarray:
        program = compose(parts["scene"], parts["contact"], _integrator(scene))
        with np.errstate(all="ignore"):
            return np.asarray(program.cost(NewtonOps(), theta[:, None] + apart, w))

    before, moving = costs(near), set()
    for name in sorted(set(traced(near[axis])) - {"sigma"}):
        # factors by which a parameter is moved; 0 becomes 0.1 and 0.5, infinity 1e4 and 1e3
        for factor, zero in ((1.1, 0.1), (0.5, 0.5)):
            value = getattr(near[axis], name)
            changed = value * factor if value and np.isfinite(value) else zero if not value else 1e4 * factor
            moved = near | {axis: _with(near[axis], {name: changed})}
            if not np.array_equal(moved["scene"].theta0(), theta) or not np.array_equal(
                costs(moved), before, equal_nan=True
            ):
                moving.add(name)
                break
    return moving


def _with(part: Any, values: dict[str, float]) -> Any:
    """Return a part with other values, of which those that it refuses are left."""
    for name, value in values.items():
        with contextlib.suppress(UserError, ValueError):
            part = dataclasses.replace(part, **{name: value})
    return part


def _integrator(scene: Scene) -> Integrator | None:
    return stepping() if isinstance(scene, MechanicalScene) else None
