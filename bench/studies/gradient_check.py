"""The program's gradient against differences of its cost, at the start and on both sides of a contact switch."""

from __future__ import annotations

import itertools
import shlex
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench import gradcheck, grid, noise, registry
from bench.contracts import ForceLaw, MechanicalScene, Problem, Program, Unsupported
from bench.grid import Cell, Experiment
from bench.session import Session
from bench.store import Columns

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = Columns.of(
    "best_error",
    "best_eps",
    "scale",
    texts=("verdict", "command", "device"),
    lists=(
        "point", "sample", "direction", "derivative_program", "check_verdict", "check_error", "check_eps",
        "eps", "derivative_differences", "relative_error", "mode_minus", "mode_plus",
    ),
)  # fmt: skip
"""One row a cell. Lists have an entry a check, but for ``eps`` and the last four, with one for each eps of each check."""

DIRECTIONS = 2
"""Directions of the checks at the start, and of those at a switch."""
DRAWN = 16
"""Directions along which a switch is looked for."""
REACH = 2.0
"""How far along a direction a switch of contact mode is looked for, in units of the natural scale."""
ASIDE = 1e-4
"""How far before and after a switch gradients are checked, in units of the natural scale."""
COLUMNS_AT_ONCE = 128
"""Rollouts in one evaluation of contact modes, always as many so that a compiling backend compiles once."""


@dataclass(frozen=True)
class Place:
    """One check to make: ``theta (d,)``, unit ``direction (d,)``, noise ``w (n_w,)``, and what they are called."""

    point: str
    theta: np.ndarray
    direction: np.ndarray
    w: np.ndarray
    number: int
    """Of the direction."""
    sample: int
    """0 without noise, 1 with it."""


def measure(cell: Cell, session: Session) -> dict[str, Any]:
    """All checks of one cell."""
    problem = session.problem(cell)
    theta = cell.scene.theta0()
    drawn = noise.draw(cell.seed, cell.scene.name, 1, 1, problem.program.n_noise, "gradient check")[0, 0]
    directions = noise.draw(cell.seed, cell.scene.name, 1, DRAWN, theta.size, "directions")[0]
    places, found = examine(problem, theta, drawn, directions, float(np.finfo(cell.backend.dtype).eps))
    verdicts = [gradcheck.diagnose(sample) for sample, _ in found]
    best = [gradcheck.best(sample) for sample, _ in found]
    errors = [float(sample.errors[i]) for (sample, _), i in zip(found, best, strict=True)]
    worst = min(range(len(found)), key=lambda i: (gradcheck.VERDICTS.index(verdicts[i]), -errors[i]))
    lost = all(verdict == "nonfinite" for verdict in verdicts)
    return {
        "status": "nonfinite" if lost else "ok",
        "reason": "no cost is finite" if lost else "",
        "verdict": verdicts[worst],
        "best_error": errors[worst],
        "best_eps": float(gradcheck.EPS[best[worst]]),
        "scale": scale_of(theta),
        "command": command(cell),
        "device": problem.device,
        "point": [place.point for place in places],
        "sample": [place.sample for place in places],
        "direction": [place.number for place in places],
        "derivative_program": [sample.derivative for sample, _ in found],
        "check_verdict": verdicts,
        "check_error": errors,
        "check_eps": [float(gradcheck.EPS[i]) for i in best],
        "eps": gradcheck.EPS.tolist(),
        "derivative_differences": _joined(sample.differences for sample, _ in found),
        "relative_error": _joined(sample.errors for sample, _ in found),
        "mode_minus": [modes[0] for _, both in found for modes in both],
        "mode_plus": [modes[1] for _, both in found for modes in both],
    }


def _joined(parts: Iterator[np.ndarray]) -> list[float]:
    return [float(value) for part in parts for value in part]


def scale_of(theta: np.ndarray) -> float:
    """The natural scale of displacements of theta: its norm, or 1 where that is less."""
    return max(1.0, float(np.linalg.norm(theta)))


def command(cell: Cell) -> str:
    """A line for the shell that repeats the checks of a cell."""
    words = [_identity(cell.scene)]
    if isinstance(cell.scene, MechanicalScene):
        words.append(f"sweep.horizon=[{cell.scene.horizon}]")
    for part in (cell.contact, cell.integrator, cell.backend):
        if part is not None:
            words.append(f"{part.kind}=[{_identity(part)}]")
    return shlex.join(["python", "-m", "bench", "gradcheck", *words, f"seed={cell.seed}"])


def _identity(plugin: Any) -> str:
    values = grid.changed(plugin)
    if isinstance(plugin, MechanicalScene):
        values.pop("horizon", None)
    return registry.identity(plugin.name, values)


# ----------------------------------------------------------------------------------------------------- checks

Modes = Callable[[np.ndarray, np.ndarray], list[str]]
"""Contact modes of rollouts ``theta (d, B)``, ``w (n_w, B)``."""


def examine(
    problem: Problem, theta: np.ndarray, drawn: np.ndarray, directions: np.ndarray, unit: float
) -> tuple[list[Place], list[tuple[gradcheck.Sample, list[tuple[str, str]]]]]:
    """Checks at ``theta (d,)``, without noise and with ``drawn (n_w,)``, along the first of ``directions (D, d)``.

    Checks at a switch of contact mode are made along the first directions that meet one, without noise. Returns where they were made, and of each its costs with the contact modes on both sides at every eps. ``unit`` is
    the unit roundoff that the program runs in. Two calls of one batch give all costs, twice.
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    modes = contact_modes(problem)
    still = np.zeros_like(drawn)
    places = [
        Place("start", theta, direction, w, number, sample)
        for sample, w in enumerate((still, drawn))
        for number, direction in enumerate(directions[:DIRECTIONS])
    ]
    if modes is not None:
        met = (boundary(modes, theta, direction, still, number) for number, direction in enumerate(directions))
        places += itertools.chain(*itertools.islice(filter(None, met), DIRECTIONS))
    step = gradcheck.EPS * scale_of(theta)
    shifts = np.concatenate([-step, step, [0.0]])
    thetas = np.stack([p.theta + s * p.direction for p in places for s in shifts], axis=1)
    noises = np.stack([p.w for p in places for _ in shifts], axis=1)
    first, second = (problem.value(thetas, noises).reshape(len(places), -1) for _ in range(2))
    gradients = problem.grad(np.stack([p.theta for p in places], axis=1), np.stack([p.w for p in places], axis=1))
    signatures = [""] * thetas.shape[1] if modes is None else modes(thetas, noises)
    found = []
    for i, place in enumerate(places):
        names = signatures[i * shifts.size : (i + 1) * shifts.size]
        sides = list(zip(names[: step.size], names[step.size : -1], strict=True))
        sample = gradcheck.Sample(
            step,
            minus=first[i, : step.size],
            centre=float(first[i, -1]),
            plus=first[i, step.size : -1],
            derivative=float(place.direction @ gradients[:, i]),
            crossing=np.array([a != b for a, b in sides]),
            repeatable=np.array_equal(first[i], second[i], equal_nan=True),
            scale=scale_of(theta),
            slope=float(np.linalg.norm(gradients[:, i])),
            unit=unit,
        )
        found.append((sample, sides))
    return places, found


def boundary(modes: Modes, theta: np.ndarray, direction: np.ndarray, w: np.ndarray, number: int) -> list[Place]:
    """Places just before, at and just after the switch of contact mode nearest to theta along a direction; none if none."""
    scale = scale_of(theta)

    def names(at: np.ndarray) -> list[str]:
        return modes(theta[:, None] + at * direction[:, None], np.repeat(w[:, None], at.size, axis=1))

    edge = switch(names, REACH * scale)
    if edge is None:
        return []
    inner, outer = edge
    side = np.sign(outer - inner)
    at = {"before": inner - side * ASIDE * scale, "at": inner, "after": outer + side * ASIDE * scale}
    return [Place(point, theta + s * direction, direction, w, number, 0) for point, s in at.items()]


def switch(names: Callable[[np.ndarray], list[str]], reach: float) -> tuple[float, float] | None:
    """The nearest two arguments, seen from 0 outwards, between which the name changes; None if none does within reach.

    Each pass looks at many arguments at once and keeps the first change, until they are neighbours in floating point.
    """
    half = np.linspace(0.0, reach, COLUMNS_AT_ONCE // 2)
    seen = names(np.concatenate([half, -half]))
    sides = ((1.0, seen[: half.size]), (-1.0, seen[half.size :]))
    changes = [(_change(names_), sign) for sign, names_ in sides if _change(names_) is not None]
    if not changes:
        return None
    index, sign = min(changes, key=lambda change: change[0] or 0)
    assert index is not None
    low, high = sign * half[index - 1], sign * half[index]
    while abs(high - low) > 4.0 * np.spacing(reach):
        grid_ = np.linspace(low, high, COLUMNS_AT_ONCE)
        index = _change(names(grid_))
        if index is None:
            break
        low, high = grid_[index - 1], grid_[index]
    return float(low), float(high)


def _change(names: Sequence[str]) -> int | None:
    """Index of the first name that differs from the first."""
    return next((i for i, name in enumerate(names) if name != names[0]), None)


# ---------------------------------------------------------------------------------------------- contact modes


class NumpyOps:
    """NumPy, a loop, and no root: enough to follow the states of a program that solves no equation."""

    xp: Any = np

    def scan(self, step: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """A loop over the leading axis."""
        for t in range(length):
            carry = step(carry, tuple(x[t] for x in xs))
        return carry

    def root(self, residual: Callable[..., Any], guess: Any, args: Any) -> Any:
        """Refused."""
        raise Unsupported("no implicit solve here")


def contact_modes(problem: Problem) -> Modes | None:
    """The contact modes of rollouts as short names, or None for a scene without contact or a backend that hides states."""
    program = problem.program
    scene = program.scene
    if not isinstance(scene, MechanicalScene) or scene.n_contacts == 0:
        return None
    rollout = _followed if not program.needs_root else _asked
    try:
        rollout(problem, scene.theta0()[:, None], np.zeros((program.n_noise, COLUMNS_AT_ONCE)))
    except Unsupported:
        return None

    def modes(theta: np.ndarray, w: np.ndarray) -> list[str]:
        width = w.shape[1]
        index = np.arange(-(-width // COLUMNS_AT_ONCE) * COLUMNS_AT_ONCE).clip(max=width - 1)
        parts = []
        for part in index.reshape(-1, COLUMNS_AT_ONCE):
            with np.errstate(all="ignore"):
                parts.append(active(program, *rollout(problem, theta[:, part], w[:, part])))
        return [signature(column) for column in np.concatenate(parts, axis=-1)[..., :width].transpose(2, 1, 0)]

    return modes


def _followed(problem: Problem, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States ``(horizon + 1, n, B)`` and controls ``(horizon, n_u, B)`` of rollouts, in NumPy."""
    theta = np.broadcast_to(theta, (theta.shape[0], w.shape[1]))
    steps = list(problem.program.steps(NumpyOps(), theta, w))
    return np.stack([np.concatenate(state) for state, _ in steps]), np.stack([u for _, u in steps[:-1]])


def _asked(problem: Problem, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same from the backend, for programs that solve equations."""
    theta = np.ascontiguousarray(np.broadcast_to(theta, (theta.shape[0], w.shape[1])))
    return problem.trajectory(theta, w)


def active(program: Program, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Which contacts act in each step, ``(horizon, n_contacts, B)``.

    Under a force law those that overlap before the step; under an impulse law those whose bodies approach and would overlap
    after it, or, where the law solves for the end of the step, those that would overlap there without contact.
    """
    scene = program.scene
    assert isinstance(scene, MechanicalScene)
    found = []
    for x, u in zip(states[:-1], controls, strict=True):
        q, v = x[: scene.n_q], x[scene.n_q :]
        if isinstance(program.contact, ForceLaw):
            found.append(scene.gap(np, q) < 0)
        elif program.needs_root:
            free = scene.velocity_factor * v + scene.dt * scene.acceleration(np, q, v, u)
            found.append(scene.gap(np, q + scene.dt * free) < 0)
        else:
            found.append((scene.gap(np, q + scene.dt * v) < 0) & (scene.gap_rate(np, q, v) < 0))
    return np.stack(found)


def signature(contacts: np.ndarray) -> str:
    """``contacts (n_contacts, horizon)`` as a short name: the steps with contact, ``12-18 30``, contacts parted by ``;``.

    Names that would be long end in a checksum of the whole.
    """
    text = ";".join(_runs(row) for row in contacts)
    return text if len(text) <= 24 else f"{text[:14]}..{zlib.crc32(text.encode()):08x}"


def _runs(row: np.ndarray) -> str:
    parts = []
    for _, group in itertools.groupby(enumerate(np.flatnonzero(row)), key=lambda pair: pair[1] - pair[0]):
        steps = [int(step) for _, step in group]
        parts.append(str(steps[0]) if len(steps) == 1 else f"{steps[0]}-{steps[-1]}")
    return " ".join(parts) or "-"


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
    """Table, summary and chart; prints the counts of verdicts and every fault."""
    from bench.report import gradient_check

    return gradient_check.write(experiment, rows)
