"""Inputs of the checks: programs of the registered plugins, samples, and NumPy operations."""

from __future__ import annotations

import contextlib
import itertools
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np

from bench.conformance.kit import Skipped, missing_environment, require, skip_unless
from bench.engines.backend import EngineBackend
from bench.host.parameters import build, parameters
from bench.measure import jumps
from bench.model import (
    Array,
    Backend,
    ContactLaw,
    EngineScene,
    ForceLaw,
    FunctionScene,
    ImpulseLaw,
    Integrator,
    LoopOps,
    MechanicalScene,
    Program,
    Scene,
    State,
    compose,
    registry,
)

Z_LIMIT = 4.5
"""Allowed difference of a sample mean from its expectation, in standard errors."""
ROUNDED = 1e-12
"""Relative difference allowed between numbers from the same few operations: a vectorised function may round differently
in another batch, by about 1e-16 each time."""
SAME = 1e-9
"""Relative difference allowed between rollouts with the same operations in another order: each of hundreds of steps
rounds by 1e-16, and springs multiply this error by up to 1e4."""
DIFFERENCED = 1e-7
"""Relative error allowed where gradients may be central differences of step 1e-6: rounding causes 1e-10 of the cost."""
PARTS = 512
"""Number of intervals of a line at the first level of a search for jumps."""
N_COLUMNS = 6
"""Number of samples on which backends are compared, always the same since some backends compile for each number."""


def available(kind: str) -> list[type[Any]]:
    """Return the plugin classes of a kind whose required modules, and environments of engines, are installed."""
    classes = [e.plugin for e in registry.entries()[kind].values() if e.plugin is not None and e.available]
    return [plugin for plugin in classes if missing_environment(plugin) is None]


@cache
def plain_backend() -> Backend:
    """Return the reference backend of all comparisons, which needs no library and compiles nothing; built in if possible."""
    for plugin in sorted(available("backends"), key=lambda plugin: not plugin.__module__.startswith("bench.plugins.")):
        is_plain = not plugin.requires and not plugin.compiles and not {"simulator", "physics"} & plugin.provides
        if is_plain and {"value", "grad", "score"} <= plugin.provides:
            return cast(Backend, plugin())
    raise Skipped("no backend is registered that needs no library")


def able_backend(program: Program) -> Backend:
    """Return the plain backend if it can run the program, else the first backend that can.

    Backends that compile come later, and engines in a Python of their own last.
    """
    others = backends()
    others.sort(key=lambda backend: (isinstance(backend, EngineBackend), backend.compiles))
    for backend in (plain_backend(), *others):
        if can_run(backend, program):
            return backend
    raise Skipped("no available backend can run it")


def backends() -> list[Backend]:
    """Return the available backends; those that cannot be built fail their own checks."""
    built = []
    for plugin in available("backends"):
        with contextlib.suppress(Exception):
            built.append(cast(Backend, plugin()))
    return built


def can_run(backend: Backend, program: Program) -> bool:
    """Return whether the backend can run the program; False if its answer is an error, which fails its own checks."""
    with contextlib.suppress(Exception):
        return backend.refusal(program) is None
    return False


@cache
def works(backend: Backend) -> bool:
    """Return whether the backend runs any of three programs of other kinds: one that does not fails its own checks."""
    for program in [p for p in distinguishing_programs(all_programs()) if can_run(backend, p)][:3]:
        with contextlib.suppress(Exception):
            backend.compile(program).value(*samples(program))
            return True
    return False


@cache
def stepping() -> Integrator:
    """Return an explicit first-order integrator that works with every contact law, since it applies impulses."""
    for plugin in available("integrators"):
        if plugin.takes_impulses and not plugin.needs_root and plugin.order == 1:
            return cast(Integrator, plugin())
    raise Skipped("no explicit first-order integrator that takes impulses is registered")


def law_for(scene: MechanicalScene, law: type[ContactLaw], values: dict[str, Any] | None = None) -> ContactLaw:
    """Return a contact law with the scene's parameter values, overridden by ``values``."""
    given = {**scene.contact_values, **(values or {})}
    return cast(ContactLaw, build(law, {k: v for k, v in given.items() if k in parameters(law)}))


def programs(scene: Scene) -> list[Program]:
    """Return the scene's programs: one with each sound law, or only one if the scene has no contacts.

    Raises :class:`Skipped` for an engine's scene if no such engine is available.
    """
    if not isinstance(scene, MechanicalScene):
        return [compose(scene)]
    if not scene.n_contacts:
        return [compose(scene, None, stepping())]
    composed = [compose(scene, law_for(scene, law), stepping()) for law in sound_laws()]
    if isinstance(scene, EngineScene):
        engines = [backend for backend in backends() if "physics" in backend.provides]
        composed = [program for program in composed if any(can_run(engine, program) for engine in engines)]
        skip_unless(composed, "no available physics engine can run it")
    return composed


@cache
def sound_laws() -> tuple[type[ContactLaw], ...]:
    """Return the available contact laws under which some scene has finite costs; all other laws fail their own checks."""
    scenes = [s for s in available("scenes") if issubclass(s, MechanicalScene) and s.n_contacts]
    return tuple(law for law in available("contacts") if any(_works(scene, law) for scene in scenes))


def _works(scene: type[MechanicalScene], law: type[ContactLaw]) -> bool:
    with contextlib.suppress(Exception):
        return _is_sound(compose(scene(), law_for(scene(), law), stepping()))
    return False


@cache
def all_programs() -> tuple[Program, ...]:
    """Return every available scene with every sound law, if costs are finite; other scenes fail their own checks."""
    result: list[Program] = []
    for scene_class in available("scenes"):
        with contextlib.suppress(Exception):
            result.extend(program for program in programs(scene_class()) if _is_sound(program))
    return tuple(result)


def _is_sound(program: Program) -> bool:
    """Return whether the plain backend computes finite costs or cannot run the program."""
    if plain_backend().refusal(program) is not None:
        return True
    try:
        return bool(np.isfinite(plain_backend().compile(program).value(*samples(program))).all())
    except Exception:
        return False


def sound_scenes() -> list[Scene]:
    """Return the scenes of :func:`all_programs`, each once."""
    return list(dict.fromkeys(program.scene for program in all_programs()))


def representative_programs(programs: Sequence[Program]) -> list[Program]:
    """Return a subset of the programs that contains every scene and every contact law."""
    few = []
    for index, (_, group) in enumerate(itertools.groupby(programs, key=lambda p: type(p.scene))):
        laws = list(group)
        few.append(laws[index % len(laws)])
    first = {type(program.contact): program for program in reversed(programs)}
    used = {type(program.contact) for program in few}
    return few + [first[law] for law in reversed(first) if law not in used]


def distinguishing_programs(programs: Iterable[Program]) -> list[Program]:
    """Return one program of each kind: function, feedback, open loop, force law, impulse law, equation to solve."""
    sorts: dict[tuple[bool, ...], Program] = {}
    for program in programs:
        law = (isinstance(program.contact, ForceLaw), isinstance(program.contact, ImpulseLaw), program.needs_root)
        sorts.setdefault((isinstance(program.scene, FunctionScene), program.noise_on_theta, *law), program)
    return list(sorts.values())


def rng(*key: str | int) -> np.random.Generator:
    """Return a random generator whose seed is the key."""
    return np.random.default_rng([zlib.crc32(str(part).encode()) for part in key])


def samples(program: Program) -> tuple[np.ndarray, np.ndarray]:
    """Return :data:`N_COLUMNS` thetas near theta0, ``(d, B)``, and noise ``(n_w, B)``."""
    draw = rng("samples", program.scene.name)
    theta = program.theta0[:, None] + 0.1 * program.scene.sigma * draw.standard_normal((program.dim, N_COLUMNS))
    return theta, draw.standard_normal((program.n_noise, N_COLUMNS))


def with_changed_column(theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return copies of theta ``(d, B)`` and noise ``(n_w, B)`` with column 2 changed."""
    column = np.arange(N_COLUMNS) == 2
    return theta + 1e-3 * column, w * (1 - 0.5 * column)


def describe(program: Program) -> str:
    """Return the names of scene and contact law."""
    return f"{program.scene.name} + {program.contact.name}" if program.contact else program.scene.name


def distance(actual: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest absolute difference, relative to the largest absolute expected number."""
    scale = np.abs(expected).max() or 1.0
    return float(np.abs(actual - expected).max() / scale)


def agree(actual: np.ndarray, expected: np.ndarray, tolerance: float, what: str) -> float:
    """Return :func:`distance`; raises :class:`Failed` with ``what`` and the distance unless it is below the tolerance."""
    off = distance(actual, expected)
    require(off < tolerance, f"{what}: off by {off:.1e}")
    return off


def standard_errors(difference: np.ndarray, error: np.ndarray, tolerance: np.ndarray | float) -> np.ndarray:
    """Return the excess of ``difference (d,)`` over a tolerance for rounding, in standard errors ``error (d,)``.

    The result is inf where a difference exceeds the tolerance and its error is 0.
    """
    beyond = np.maximum(np.abs(difference) - tolerance, 0.0)
    return np.divide(beyond, error, out=np.where(beyond > 0, np.inf, 0.0), where=error > 0)


@dataclass(frozen=True)
class BareScene(MechanicalScene):
    """Bodies at rest at theta without forces, whose cost is their first coordinate: what the checks' own scenes change."""

    def theta0(self) -> np.ndarray:
        """Return zeros, ``(n_q,)``."""
        return np.zeros(self.n_q)

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return positions theta and velocities 0."""
        return State(theta, 0.0 * theta)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return zeros, ``(n_v, B)``."""
        return 0.0 * q

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the first coordinate, ``(B,)``."""
        return q[0]


class NewtonOps(LoopOps):
    """NumPy operations for checks without a backend: a loop, Newton's method, and a count of equations solved."""

    def __init__(self) -> None:
        super().__init__(np)
        self.solved = 0

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return the root by Newton's method with forward differences, iterated until the steps are rounding."""
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


def largest_jump(program: Program, lines: int = 1, offset: float = 0.0) -> float:
    """Return the largest jump of the cost along lines through theta0, relative to the cost's range on the line, or 0.

    ``offset`` moves the lines by that many sigma in every coordinate. Without an offset, a rollout that fails raises
    :class:`Failed`. With an offset, failed rollouts do not count as jumps.
    """
    problem = able_backend(program).compile(program)
    theta = program.theta0 + offset * program.scene.sigma

    def cost(points: np.ndarray) -> np.ndarray:
        costs = problem.value(points, np.zeros((program.n_noise, points.shape[1])))
        if np.isfinite(costs).all():
            return costs
        require(offset, f"{describe(program)}: costs within 4 sigma of theta0 are not finite")
        return np.full_like(costs, np.nan)

    largest = 0.0
    for line in range(lines):
        e = 4 * program.scene.sigma * (np.ones(theta.size) if line == 0 else rng("line").uniform(-1, 1, theta.size))
        jump = jumps.largest_jump(cost, (theta - e)[:, None], (theta + e)[:, None], PARTS)
        if jump.height:
            largest = max(largest, jump.height / jump.span)
    return largest
