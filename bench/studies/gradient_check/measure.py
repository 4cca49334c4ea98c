"""The program's gradient against differences of its cost, at the start and on both sides of a contact switch."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.measure import gradcheck, noise
from bench.measure.contacts import acting
from bench.model import SURROGATE, LoopOps, Problem, Rollout, Unsupported
from bench.report.reproduce import check_of
from bench.sweep.cell import Cell
from bench.sweep.session import Session

COLUMNS_AT_ONCE = 128
"""Rollouts per evaluation of contact modes, always the same number so that a compiling backend compiles once."""


@dataclass(frozen=True)
class Place:
    """One check to make: ``theta (d,)``, unit ``direction (d,)``, noise ``w (n_w,)``, and their labels."""

    point: str
    theta: np.ndarray
    direction: np.ndarray
    w: np.ndarray
    number: int
    """Number of the direction."""
    sample: int
    """0 without noise, 1 with it."""


@dataclass(frozen=True)
class Search:
    """Where gradients are checked; see the parameters of the study."""

    directions: int
    drawn: int
    reach: float
    aside: float


def measure(cell: Cell, session: Session, search: Search) -> dict[str, Any]:
    """Make all checks of one cell."""
    problem = session.problem(cell)
    theta = problem.program.theta0
    drawn = noise.draw(cell.seed, cell.scene.name, 1, 1, problem.program.n_noise, "gradient check")[0, 0]
    directions = noise.draw(cell.seed, cell.scene.name, 1, search.drawn, theta.size, "directions")[0]
    places, found = examine(problem, theta, drawn, directions, float(np.finfo(cell.backend.dtype).eps), search)
    verdicts = [gradcheck.diagnose(sample) for sample, _ in found]
    best = [gradcheck.best(sample) for sample, _ in found]
    errors = [float(sample.errors[i]) for (sample, _), i in zip(found, best, strict=True)]
    worst = min(range(len(found)), key=lambda i: (gradcheck.VERDICTS.index(verdicts[i]), -errors[i]))
    lost = all(verdict == "nonfinite" for verdict in verdicts)
    return {
        "status": "nonfinite" if lost else "ok",
        "reason": "no cost is finite" if lost else SURROGATE if problem.program.surrogate else "",
        "verdict": verdicts[worst],
        "best_error": errors[worst],
        "best_eps": float(gradcheck.EPS[best[worst]]),
        "scale": scale_of(theta),
        "command": check_of(cell),
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
    """Return the natural scale of displacements of theta: its norm, or 1 where that is less."""
    return max(1.0, float(np.linalg.norm(theta)))


# ----------------------------------------------------------------------------------------------------- checks

Modes = Callable[[np.ndarray, np.ndarray], list[str]]
"""Contact modes of rollouts ``theta (d, B)``, ``w (n_w, B)``, as short names."""


def examine(
    problem: Problem, theta: np.ndarray, drawn: np.ndarray, directions: np.ndarray, unit: float, search: Search
) -> tuple[list[Place], list[tuple[gradcheck.Sample, list[tuple[str, str]]]]]:
    """Make checks at ``theta (d,)``, without noise and with ``drawn (n_w,)``, along the first ``directions (D, d)``.

    Checks at a switch of contact mode are made along the first directions that meet one, without noise. Returns the
    places and, for each, its costs with the contact modes on both sides at every eps. ``unit`` is the unit roundoff of
    the program's arithmetic. Two calls of one batch give all costs, twice.
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    modes = contact_modes(problem)
    still = np.zeros_like(drawn)
    places = [
        Place("start", theta, direction, w, number, sample)
        for sample, w in enumerate((still, drawn))
        for number, direction in enumerate(directions[: search.directions])
    ]
    if modes is not None:
        met = (boundary(modes, theta, direction, still, number, search) for number, direction in enumerate(directions))
        places += itertools.chain(*itertools.islice(filter(None, met), search.directions))
    scale, count = scale_of(theta), gradcheck.EPS.size
    thetas = np.concatenate([gradcheck.points(p.theta, scale * p.direction[:, None], unit) for p in places], axis=1)
    each = thetas.shape[1] // len(places)
    noises = np.repeat(np.stack([p.w for p in places], axis=1), each, axis=1)
    first, second = (problem.value(thetas, noises).reshape(len(places), -1) for _ in range(2))
    gradients = problem.grad(np.stack([p.theta for p in places], axis=1), np.stack([p.w for p in places], axis=1))
    signatures = [""] * thetas.shape[1] if modes is None else modes(thetas, noises)
    names = np.array(signatures, dtype=object).reshape(len(places), -1)
    minus, plus = names[:, :count], names[:, count : 2 * count]
    samples = gradcheck.samples(
        first,
        np.full(len(places), scale),
        np.array([place.direction @ gradients[:, i] for i, place in enumerate(places)]),
        unit,
        crossing=minus != plus,
        repeatable=((first == second) | (np.isnan(first) & np.isnan(second))).all(axis=1),
    )
    sides = [list(zip(*both, strict=True)) for both in zip(minus, plus, strict=True)]
    found = list(zip(samples, sides, strict=True))
    return places, found


def boundary(
    modes: Modes, theta: np.ndarray, direction: np.ndarray, w: np.ndarray, number: int, search: Search
) -> list[Place]:
    """Return places just before, at and just after the switch of contact mode nearest to theta, if there is one."""
    scale = scale_of(theta)

    def names(at: np.ndarray) -> list[str]:
        return modes(theta[:, None] + at * direction[:, None], np.repeat(w[:, None], at.size, axis=1))

    edge = switch(names, search.reach * scale)
    if edge is None:
        return []
    inner, outer = edge
    side = np.sign(outer - inner)
    at = {"before": inner - side * search.aside * scale, "at": inner, "after": outer + side * search.aside * scale}
    return [Place(point, theta + s * direction, direction, w, number, 0) for point, s in at.items()]


def switch(names: Callable[[np.ndarray], list[str]], reach: float) -> tuple[float, float] | None:
    """Return the nearest two arguments, from 0 outwards, between which the name changes; None if it never does.

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
    """Return the index of the first name that differs from the one before all others."""
    return next((i for i, name in enumerate(names) if name != names[0]), None)


# ---------------------------------------------------------------------------------------------- contact modes


def contact_modes(problem: Problem) -> Modes | None:
    """Return the function that names contact modes; None for a scene without contact or a backend that hides states."""
    program = problem.program
    if not isinstance(program, Rollout) or not program.scene.n_contacts:
        return None
    rollout = _followed if not program.needs_root else _asked
    try:
        rollout(problem, program.theta0[:, None], np.zeros((program.n_noise, COLUMNS_AT_ONCE)))
    except Unsupported:
        return None

    def modes(theta: np.ndarray, w: np.ndarray) -> list[str]:
        width = w.shape[1]
        index = np.arange(-(-width // COLUMNS_AT_ONCE) * COLUMNS_AT_ONCE).clip(max=width - 1)
        parts = []
        for part in index.reshape(-1, COLUMNS_AT_ONCE):
            with np.errstate(all="ignore"):
                parts.append(acting(program, *rollout(problem, theta[:, part], w[:, part])))
        return [signature(column) for column in np.concatenate(parts, axis=-1)[..., :width].transpose(2, 1, 0)]

    return modes


def _followed(problem: Problem, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states ``(horizon + 1, n, B)`` and controls ``(horizon, n_u, B)`` of rollouts, computed in NumPy."""
    theta = np.broadcast_to(theta, (theta.shape[0], w.shape[1]))
    program = problem.program
    assert isinstance(program, Rollout)
    steps = list(program.steps(LoopOps(), theta, w))
    return np.stack([np.concatenate(state) for state, _ in steps]), np.stack([u for _, u in steps[:-1]])


def _asked(problem: Problem, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same from the backend, for programs that solve equations."""
    theta = np.ascontiguousarray(np.broadcast_to(theta, (theta.shape[0], w.shape[1])))
    return problem.trajectory(theta, w)


def signature(contacts: np.ndarray) -> str:
    """Return ``contacts (n_contacts, horizon)`` as a short name: steps in contact, ``12-18 30``, split by ``;``.

    A name that would be too long is cut and ends in a checksum of the whole.
    """
    text = ";".join(_runs(row) for row in contacts)
    return text if len(text) <= 24 else f"{text[:14]}..{zlib.crc32(text.encode()):08x}"


def _runs(row: np.ndarray) -> str:
    parts = []
    for _, group in itertools.groupby(enumerate(np.flatnonzero(row)), key=lambda pair: pair[1] - pair[0]):
        steps = [int(step) for _, step in group]
        parts.append(str(steps[0]) if len(steps) == 1 else f"{steps[0]}-{steps[-1]}")
    return " ".join(parts) or "-"
