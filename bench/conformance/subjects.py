"""What checks run plugins on: programs of what is registered, samples, and NumPy operations of their own."""

from __future__ import annotations

import contextlib
import itertools
import zlib
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numpy as np

from bench import registry
from bench.conformance.kit import Skipped, require
from bench.contracts import (
    Array,
    Backend,
    Contact,
    ContactLaw,
    ForceLaw,
    FunctionScene,
    ImpulseLaw,
    Integrator,
    MechanicalScene,
    Scene,
)
from bench.program import Program

LIMIT = 4.5
"""Standard errors that a sample mean may be away from what it should be."""
DIFFERENCED = 1e-7
"""Relative error allowed where gradients may come from central differences of step 1e-6: rounding leaves 1e-10 of the cost."""
NO_JUMP = 1e-6
"""Change of a cost, relative to its range, below which rounding may be what keeps it from falling further."""
COLUMNS = 6
"""Samples on which backends are compared; one number for all, since some compile for each."""


def available(kind: str) -> list[type[Any]]:
    """The plugin classes of a kind that can be used here."""
    return [e.plugin for e in registry.entries()[kind].values() if e.plugin is not None and e.available]


@cache
def plain_backend() -> Backend:
    """The backend that needs no library and compiles nothing: what everything else is compared with."""
    for plugin in available("backends"):
        if not plugin.requires and not plugin.compiles and {"value", "grad", "score"} <= plugin.provides:
            return plugin()
    raise Skipped("no backend without a library of its own is registered")


def able_backend(program: Program) -> Backend:
    """The plain backend if it can run the program, else the first that can; those that compile come last."""
    others = sorted((plugin() for plugin in available("backends")), key=lambda backend: backend.compiles)
    for backend in (plain_backend(), *others):
        if can_run(backend, program):
            return backend
    raise Skipped("no available backend can run it")


def can_run(backend: Backend, program: Program) -> bool:
    """Whether the backend has what the program needs and does not refuse it."""
    return program.needs <= backend.provides and backend.refuses(program) is None


@cache
def stepping() -> Integrator:
    """An integrator that works with every contact law, of first order: it leaves impacts to the law."""
    for plugin in available("integrators"):
        if plugin.takes_impulses and not plugin.needs_root and plugin.order == 1:
            return plugin()
    raise Skipped("no explicit first-order integrator that takes impulses is registered")


def law_for(scene: MechanicalScene, law: type[ContactLaw], values: dict[str, Any] | None = None) -> ContactLaw:
    """A contact law with the values that the scene gives to its parameters."""
    given = {**scene.contact_values, **(values or {})}
    return registry.build(law, {k: v for k, v in given.items() if k in registry.parameters(law)})  # type: ignore[return-value]


def programs(scene: Scene) -> list[Program]:
    """The scene under every sound contact law, if it has contacts; raises :class:`Skipped` where only absent engines run it."""
    if not isinstance(scene, MechanicalScene):
        return [Program(scene, None, None)]
    if not scene.n_contacts:
        return [Program(scene, None, stepping())]
    found = [Program(scene, law_for(scene, law), stepping()) for law in sound_laws()]
    if scene.needs_physics:
        engines = [plugin() for plugin in available("backends") if "physics" in plugin.provides]
        found = [program for program in found if any(can_run(engine, program) for engine in engines)]
        if not found:
            raise Skipped("no available physics engine can run it")
    return found


@cache
def sound_laws() -> tuple[type[ContactLaw], ...]:
    """The available contact laws with which some available scene has finite costs; others fail their own checks."""
    scenes = [s for s in available("scenes") if issubclass(s, MechanicalScene) and s.n_contacts]
    return tuple(law for law in available("contacts") if any(_works(scene, law) for scene in scenes))


def _works(scene: type[MechanicalScene], law: type[ContactLaw]) -> bool:
    with contextlib.suppress(Exception):
        return _is_sound(Program(scene(), law_for(scene(), law), stepping()))
    return False


@cache
def all_programs() -> tuple[Program, ...]:
    """Every available scene under every sound contact law, where costs are finite; what fails does so in its own checks."""
    found: list[Program] = []
    for scene_class in available("scenes"):
        with contextlib.suppress(Exception):
            found.extend(program for program in programs(scene_class()) if _is_sound(program))
    return tuple(found)


def _is_sound(program: Program) -> bool:
    """Whether the plain backend finds finite costs, or has no say."""
    if not can_run(plain_backend(), program):
        return True
    try:
        return bool(np.isfinite(plain_backend().compile(program).value(*samples(program))).all())
    except Exception:
        return False


def sound_scenes() -> list[Scene]:
    """The scenes of :func:`all_programs`."""
    return list(dict.fromkeys(program.scene for program in all_programs()))


def covering(found: Iterable[Program]) -> list[Program]:
    """Fewer programs, in which every scene and every contact law still occurs."""
    chosen = []
    for index, (_, group) in enumerate(itertools.groupby(found, key=lambda p: type(p.scene))):
        laws = list(group)
        chosen.append(laws[index % len(laws)])
    used = {type(p.contact) for p in chosen}
    for program in found:
        if type(program.contact) not in used:
            used.add(type(program.contact))
            chosen.append(program)
    return chosen


def telling(found: Iterable[Program]) -> list[Program]:
    """One program of each sort: function, feedback, open loop, force law, impulse law, equation to solve."""
    sorts: dict[tuple[bool, ...], Program] = {}
    for program in found:
        law = (isinstance(program.contact, ForceLaw), isinstance(program.contact, ImpulseLaw), program.needs_root)
        sorts.setdefault((isinstance(program.scene, FunctionScene), program.noise_on_theta, *law), program)
    return list(sorts.values())


def rng(*key: str | int) -> np.random.Generator:
    """A generator of fixed seed."""
    return np.random.default_rng([zlib.crc32(str(part).encode()) for part in key])


def samples(program: Program, count: int = COLUMNS) -> tuple[np.ndarray, np.ndarray]:
    """A theta of its own, near theta0, and noise for each of ``count`` columns."""
    draw = rng("samples", program.scene.name)
    theta = program.scene.theta0()[:, None] + 0.1 * program.scene.sigma * draw.standard_normal((program.dim, count))
    return theta, draw.standard_normal((program.n_noise, count))


def disturbed(theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples of which column 2 alone is another."""
    column = np.arange(COLUMNS) == 2
    return theta + 1e-3 * column, w * (1 - 0.5 * column)


def title(program: Program) -> str:
    """Scene and contact law."""
    return f"{program.scene.name} + {program.contact.name}" if program.contact else program.scene.name


def distance(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, relative to the size of the numbers."""
    scale = np.abs(expected).max() or 1.0
    return float(np.abs(found - expected).max() / scale)


class Ops:
    """NumPy for checks that need no backend: a loop, Newton's method, and a count of the equations solved."""

    xp: Any = np

    def __init__(self) -> None:
        self.solved = 0

    def scan(self, step: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """A loop over the leading axis."""
        for t in range(length):
            carry = step(carry, tuple(x[t] for x in xs))
        return carry

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Newton's method with forward differences, until it no longer moves."""
        self.solved += 1
        z = np.array(guess, dtype=float)
        for _ in range(50):
            r = residual(z, args)
            steps = 1e-7 * np.abs(z) + 1e-9
            moved = np.eye(len(z))[:, :, None] * steps
            jacobian = np.stack([(residual(z + moved[j], args) - r) / steps[j] for j in range(len(z))], axis=1)
            change = np.linalg.solve(np.moveaxis(jacobian, -1, 0), np.moveaxis(r, -1, 0)[..., None])[..., 0].T
            z = z - change
            if np.all(np.abs(change) <= 1e-13 * np.abs(z) + 1e-15):
                break
        return z


def largest_jump(program: Program, lines: int = 1) -> float:
    """The largest jump of the cost along lines through theta0, relative to its range on them; 0 without one.

    The eight intervals of largest change are cut into 64, again and again: across a slope the change falls with their
    length, across a jump it stays.
    """
    problem = able_backend(program).compile(program)
    theta, largest = program.scene.theta0(), 0.0
    for line in range(lines):
        e = 4 * program.scene.sigma * (np.ones(theta.size) if line == 0 else rng("line").uniform(-1, 1, theta.size))
        left, width = np.linspace(-1.0, 1.0, 8, endpoint=False), 0.25
        span, changes = 0.0, [0.0]
        while width > 1e-11:
            nodes = left[:, None] + width * np.linspace(0.0, 1.0, 65)
            shifts = nodes.reshape(1, -1)
            cost = problem.value(theta[:, None] + e[:, None] * shifts, np.zeros((program.n_noise, shifts.size)))
            require(np.isfinite(cost).all(), f"{title(program)}: costs within 4 sigma of theta0 are not finite")
            span = max(span, float(np.ptp(cost)))
            change = np.abs(np.diff(cost.reshape(nodes.shape), axis=1))
            changes.append(float(change.max()))
            chosen = np.argsort(change, axis=None)[-8:]
            left, width = nodes[:, :-1].ravel()[chosen], width / 64
        if changes[-1] > 0.1 * changes[-2] and changes[-1] > NO_JUMP * span:
            largest = max(largest, changes[-1] / span)
    return largest


def contact_of(scene: MechanicalScene) -> Contact:
    """The contact geometry of a scene, in NumPy."""
    return Contact(
        gap=lambda q: scene.gap(np, q),
        gap_rate=lambda q, v: scene.gap_rate(np, q, v),
        acceleration=lambda q, force: scene.contact_acceleration(np, q, force),
        restitution=scene.restitution,
    )
