"""Fits of named parameters to records of the motion: in one rollout, in windows that meet, in windows on their own."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.measure import noise, performance
from bench.measure.identification import Information
from bench.model import Answer, Decision, Identified, LoopOps, MechanicalScene, Optimizer, Rollout, State, compose

STEP = 1e-5
"""Step of central differences in logarithms: errors about 1e-10 relative."""
WAYS = ("single", "multiple", "windows")
TIGHT = 100.0
"""Weight of a gap between windows of multiple shooting, in units of a measurement's."""
MOVED = 0.5
"""Change of an estimate under half the step, in units of the bound of its error, from which on it holds for its step
only: to first order as much error is left, and with one bound of bias a third of the intervals miss the truth."""

Settings = Any
"""The study, whose parameters say how to fit; it imports this module, so its type has no name here."""


@dataclass(frozen=True)
class Model:
    """A program whose named parameters are found from measured positions."""

    program: Rollout
    names: tuple[str, ...]
    measured: tuple[int, ...]
    every: tuple[int, ...]
    """The steps after which it is measured, counted from 1."""

    @property
    def values(self) -> np.ndarray:
        """The parameters as the scene has them, ``(p,)``."""
        return self.program.theta0

    def _start(self, theta: np.ndarray) -> tuple[Rollout, np.ndarray, State, tuple[np.ndarray, ...]]:
        w = np.zeros((self.program.n_noise, theta.shape[1]))
        program, own, w = self.program.resolved(LoopOps(), theta, w)
        own, state, scanned = program.start(LoopOps(), own, w)
        return program, own, state, scanned

    def first(self, theta: np.ndarray) -> np.ndarray:
        """Return the state at the start for ``theta (p, B)``, ``(n, B)``."""
        return np.concatenate(self._start(theta)[2])

    def follow(self, theta: np.ndarray, x: np.ndarray, begin: np.ndarray, steps: int) -> np.ndarray:
        """Return states after each of ``steps`` steps from ``x (n, B)`` before step ``begin (B,)``: ``(steps, n, B)``."""
        program, own, state, scanned = self._start(theta)
        n_q, columns = len(state.q), np.arange(theta.shape[1])
        now, states = State(x[:n_q], x[n_q:]), []
        with np.errstate(all="ignore"):
            for s in range(steps):
                at = np.minimum(begin + s, program.scene.horizon - 1)
                u = program.control(LoopOps(), own, now, tuple(part[at, :, columns].T for part in scanned))
                now = program.step(LoopOps(), now, u)
                states.append(np.concatenate(now))
        return np.stack(states)

    def record(self, theta: np.ndarray) -> np.ndarray:
        """Return what is measured along whole rollouts of ``theta (p, B)``, ``(m, B)``."""
        states = self.follow(theta, self.first(theta), np.zeros(theta.shape[1], dtype=int), self.program.scene.horizon)
        return states[np.array(self.every) - 1][:, list(self.measured)].reshape(-1, theta.shape[1])


def model_of(cell: Cell, scene: MechanicalScene | None = None, thinned: int = 1) -> Model:
    """Return the cell's model; ``scene`` may be the same one with a step ``thinned`` times shorter."""
    own = cell.scene
    assert isinstance(own, MechanicalScene)
    scene = scene or own
    names = cell.decision.names or (own.unknowns if isinstance(own, Identified) else ())
    program = compose(scene, cell.contact, cell.integrator, Decision(tuple(names)))
    assert isinstance(program, Rollout)
    if (program.theta0 <= 0).any():
        raise Unsupported(f"unknowns {list(names)} are {program.theta0.tolist()}: relative errors need positive ones")
    measured = own.measured if isinstance(own, Identified) else None
    places = tuple(range(scene.n_q)) if measured is None else measured
    last = own.horizon
    steps = (last,) if isinstance(own, Identified) and own.end_only else tuple(range(1, last + 1))
    return Model(program, tuple(names), places, tuple(thinned * step for step in steps))


def finer(scene: MechanicalScene, times: int) -> MechanicalScene:
    """Return the scene with a step that many times shorter, and as long a motion."""
    return dataclasses.replace(scene, dt=scene.dt / times, horizon=scene.horizon * times)


def read(path: str, scene: MechanicalScene) -> np.ndarray:
    """Return measurements from a CSV file, ``(m,)``, a line per measurement; raises ValueError for another length."""
    data = np.genfromtxt(path, delimiter=",", ndmin=2)
    if np.isnan(data[0]).all():
        data = data[1:]  # a header
    measured = scene.measured if isinstance(scene, Identified) else None
    width = scene.n_q if measured is None else len(measured)
    length = 1 if isinstance(scene, Identified) and scene.end_only else scene.horizon
    if data.shape != (length, width) or not np.isfinite(data).all():
        raise ValueError(
            f"data={path} has {data.shape[0]} lines of {data.shape[1]} numbers, scene {scene.name} with horizon="
            f"{scene.horizon} is measured {length} times in {width} positions, each a finite number"
        )
    return data.ravel()


# ------------------------------------------------------------------------------------------------- ways of fitting


@dataclass(frozen=True)
class Fitting:
    """Residuals of several fits at once: log parameters, then the states before each later window, divided by ``unit``."""

    model: Model
    way: str
    count: int
    noise: float
    unit: np.ndarray
    """Scale of the states, ``(n,)``."""

    @property
    def dim(self) -> int:
        """Length of what is found."""
        return len(self.model.names) + (self.count - 1) * len(self.unit)

    @property
    def steps(self) -> int:
        """Steps of a window."""
        return self.model.program.scene.horizon // self.count

    def residuals(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return standardised residuals ``(m, B)`` of ``points (dim, B)`` against ``data (m', B)``."""
        p, batch, n = len(self.model.names), points.shape[1], len(self.unit)
        theta = np.exp(points[:p])
        first = self.model.first(theta)
        later = points[p:].reshape(self.count - 1, n, batch) * self.unit[:, None]
        starts = np.concatenate([first[None], later])
        flat = np.moveaxis(starts, 0, 1).reshape(n, -1)  # window by window, columns within
        begin = np.repeat(np.arange(self.count) * self.steps, batch)
        states = self.model.follow(np.tile(theta, (1, self.count)), flat, begin, self.steps)
        states = states.reshape(self.steps, n, self.count, batch)
        path = np.moveaxis(states, 2, 0).reshape(self.count * self.steps, n, batch)
        seen = path[np.array(self.model.every) - 1][:, list(self.model.measured)].reshape(-1, batch)
        parts = [(seen - data) / self.noise]
        if self.way == "multiple":
            gaps = (states[-1, :, :-1] - np.moveaxis(later, 0, 1)).reshape(-1, batch)
            parts.append(TIGHT * gaps / self.noise)
        return np.concatenate(parts)

    def jacobians(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return their derivatives by central differences, ``(m, dim, B)``."""
        batch = points.shape[1]
        shifts = STEP * np.repeat(np.eye(self.dim), batch, axis=1)
        wide, many = np.tile(points, (1, self.dim)), np.tile(data, (1, self.dim))
        change = self.residuals(wide + shifts, many) - self.residuals(wide - shifts, many)
        return change.reshape(len(change), self.dim, batch) / (2 * STEP)

    def start(self, theta: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return where fits start, ``(dim, B)``: windows at measured positions and the speeds between them."""
        p, batch, n = len(self.model.names), data.shape[1], len(self.unit)
        places = np.zeros((self.count - 1, n, batch))
        if self.count > 1:
            rollout = self.model.follow(
                theta, self.model.first(theta), np.zeros(batch, dtype=int), self.steps * self.count
            )
            at = np.arange(1, self.count) * self.steps
            places[:] = rollout[at - 1]
            table = data.reshape(-1, len(self.model.measured), batch)
            n_q, dt = self.model.program.scene.n_q, self.model.program.scene.dt
            if n == 2 * n_q:
                for column, place in enumerate(self.model.measured):
                    places[:, place] = table[at - 1, column]
                    places[:, n_q + place] = (table[at, column] - table[at - 2, column]) / (2 * dt)
        return np.concatenate([np.log(theta), (places / self.unit[:, None]).reshape(-1, batch)])[
            : p + places[:, :, 0].size
        ]


def fitted(fitting: Fitting, optimizer: Optimizer, start: np.ndarray, data: np.ndarray, iterations: int) -> np.ndarray:
    """Return the points ``(dim, B)`` that an optimizer reaches from ``start (dim, B)``, all fits side by side."""
    states = [optimizer.start(column) for column in start.T]
    nothing = np.empty((fitting.dim, 0))
    for _ in range(iterations):
        asked = [optimizer.ask(state, nothing) for state in states]
        counts = [points.shape[1] for points in asked]
        points, many = np.concatenate(asked, axis=1), np.repeat(data, counts, axis=1)
        wanted = frozenset().union(*(optimizer.required_fields(state) for state in states))
        residual = fitting.residuals(points, many)
        jacobian = fitting.jacobians(points, many) if wanted & {"gradient", "jacobian"} else None
        ends = np.cumsum([0, *counts])
        for i, (low, high) in enumerate(itertools.pairwise(ends)):
            own = residual[:, low:high]
            slope = None if jacobian is None else jacobian[:, :, low:high]
            known = {
                "value": 0.5 * (own**2).sum(axis=0), "residual": own, "jacobian": slope,
                "gradient": None if slope is None else np.einsum("mdb,mb->db", slope, own),
            }  # fmt: skip
            answer = Answer(**{name: known[name] for name in optimizer.required_fields(states[i])})
            states[i] = optimizer.tell(states[i], asked[i], answer)
    return np.stack([state["theta"] for state in states], axis=1)


def windows_of(horizon: int, most: int) -> int:
    """Return the largest number of equal windows up to ``most``, each of at least two steps; one where there is one step."""
    return max((n for n in range(1, most + 1) if horizon % n == 0 and horizon // n >= 2), default=1)


def measure(cell: Cell, settings: Settings) -> dict[str, Any]:
    """Fit all records in all ways, and compare with the bound."""
    optimizer, scene = cell.parts["optimizer"], cell.scene
    assert isinstance(optimizer, Optimizer)
    assert isinstance(scene, MechanicalScene)
    model = model_of(cell)
    truth = model.values
    known = information(model, truth, settings.measurement)
    data = records(cell, model, settings)
    factor = np.where(np.arange(data.shape[1]) % 2 == 0, settings.start, 1.0 / settings.start)
    start = truth[:, None] * factor[None, :]
    if cell.decision.at is not None:
        start = np.repeat(np.array(cell.decision.at)[:, None], data.shape[1], axis=1)
    result: dict[str, Any] = {
        "status": "ok", "reason": "", "words": known.words, "rank": known.rank, "condition": known.condition,
        "fits": data.shape[1], "unknowns": list(model.names), "truth": truth.tolist(), "start": start[:, 0].tolist(),
        "invariants": known.labels, "bound": np.sqrt(np.diag(known.covariance())).tolist() if known.rank else [],
        "fisher": known.fisher.ravel().tolist(), **step_dependence(cell, model, known, settings),
    }  # fmt: skip
    lines: dict[str, list[Any]] = {name: [] for name in LISTS}
    count = windows_of(scene.horizon, settings.windows)
    whole = len(model.every) == scene.horizon
    for way in WAYS if whole and count > 1 else WAYS[:1]:
        for name, value in _way(model, way, count, optimizer, start, data, known, settings).items():
            lines[name].extend(value if isinstance(value, list) else [value])
    return result | lines


LISTS = (
    "shooting", "converged", "converged_low", "converged_high", "error", "coverage", "coverage_low", "coverage_high",
    "hidden", "estimate", "estimate_low", "estimate_high",
)  # fmt: skip


def _way(
    model: Model, way: str, count: int, optimizer: Optimizer, start: np.ndarray, data: np.ndarray, known: Information,
    settings: Settings,
) -> dict[str, Any]:  # fmt: skip
    """Return the results of one way of fitting."""
    states = model.follow(
        model.values[:, None], model.first(model.values[:, None]), np.zeros(1, dtype=int), model.program.scene.horizon
    )
    unit = np.maximum(np.abs(states).max(axis=(0, 2)), 1e-6)
    fitting = Fitting(model, way, 1 if way == "single" else count, settings.measurement, unit)
    found = fitted(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
    residual = fitting.residuals(found, data)
    p, measured = len(model.names), len(data)
    square = (residual[:measured] ** 2).sum(axis=0)
    free = max(measured - fitting.dim, 1)
    fits = np.isfinite(square) & (square < measured + 5 * math.sqrt(2 * max(measured, free)))
    jacobian = fitting.jacobians(found, data)
    logs, target = known.invariants @ found[:p], known.invariants @ np.log(model.values)
    bound = np.sqrt(np.diag(known.covariance()))
    errors, inside, hidden, halves = [], [], 0, []
    for i in range(data.shape[1]):
        own = _parameters_only(jacobian[:, :, i], p)
        if not np.isfinite(own).all():
            halves.append(np.full(known.rank, np.nan))
            continue
        seen = Information(model.names, own)
        hidden += seen.rank > known.rank
        inverse = np.linalg.pinv(seen.fisher, rcond=1e-11, hermitian=True)
        halves.append(performance.Z * np.sqrt(np.diag(known.invariants @ inverse @ known.invariants.T)))
        if fits[i] and settings.data is None:
            errors.append((logs[:, i] - target) / bound)
            inside.append(np.abs(logs[:, i] - target) <= halves[-1])
    good, all_fits = int(fits.sum()), data.shape[1]
    low, high = performance.wilson(good, all_fits)
    held = np.array(inside, dtype=float)
    covered = float(held.mean()) if held.size else math.nan
    # the invariants of one record are dependent: records are what is drawn
    interval = performance.wilson(round(covered * good), good) if held.size else (math.nan, math.nan)
    middle = np.median(logs[:, fits], axis=1) if good else np.full(known.rank, np.nan)
    return {
        "shooting": way, "converged": good / all_fits, "converged_low": low, "converged_high": high,
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors else math.nan,
        "coverage": covered, "coverage_low": interval[0], "coverage_high": interval[1], "hidden": hidden,
        "estimate": np.exp(middle).tolist(), "estimate_low": np.exp(logs[:, 0] - halves[0]).tolist(),
        "estimate_high": np.exp(logs[:, 0] + halves[0]).tolist(),
    }  # fmt: skip


def _parameters_only(jacobian: np.ndarray, p: int) -> np.ndarray:
    """Return the Jacobian by the parameters with the states of windows projected out: their information is lost."""
    if jacobian.shape[1] == p or not np.isfinite(jacobian).all():
        return jacobian[:, :p]
    basis, _ = np.linalg.qr(jacobian[:, p:])
    return jacobian[:, :p] - basis @ (basis.T @ jacobian[:, :p])


def information(model: Model, theta: np.ndarray, sigma: float) -> Information:
    """Return what a record of ``theta (p,)`` says about the logarithms of its parameters, by single shooting."""
    p = len(theta)
    shifts = STEP * np.concatenate([np.eye(p), -np.eye(p)], axis=1)
    seen = model.record(np.exp(np.log(theta)[:, None] + shifts))
    return Information(model.names, (seen[:, :p] - seen[:, p:]) / (2 * STEP * sigma))


def records(cell: Cell, model: Model, settings: Settings) -> np.ndarray:
    """Return the records to fit, ``(m, B)``: the user's own, or ``repeats`` noisy ones of the truth."""
    assert isinstance(cell.scene, MechanicalScene)
    if settings.data is not None:
        return read(settings.data, cell.scene)[:, None]
    source = model if settings.refine == 1 else model_of(cell, finer(cell.scene, settings.refine), settings.refine)
    clean = source.record(source.values[:, None])
    drawn = noise.draw(cell.seed, cell.scene.name, cell.repeats, 1, len(clean), "identify: measurements")[:, 0].T
    return clean + settings.measurement * drawn


def step_dependence(cell: Cell, model: Model, known: Information, settings: Settings) -> dict[str, Any]:
    """Return how far a fit without noise moves when the model's step is halved, and what that says.

    To first order: the least-squares change of the parameters that takes back the change of the record.
    """
    assert isinstance(cell.scene, MechanicalScene)
    half = model_of(cell, finer(cell.scene, 2), 2)
    theta = model.values[:, None]
    change = (half.record(theta) - model.record(theta))[:, 0] / settings.measurement
    if not known.rank or not np.isfinite(change).all():
        return {"step_shift": math.nan, "step_note": "not distinguishable"}
    moved = known.invariants @ np.linalg.lstsq(known.jacobian, change, rcond=1e-8)[0]
    shift, bound = np.abs(moved), np.sqrt(np.diag(known.covariance()))
    worst = int(np.argmax(shift / bound))
    size = f"{shift[worst]:.2g} of its value, {shift[worst] / bound[worst]:.2g} times the bound of its error"
    if shift[worst] > MOVED * bound[worst]:
        note = f"holds for this time step only: half the step moves {known.labels[worst]} by {size}"
    else:
        note = f"holds for other steps too: half the step moves {known.labels[worst]} by {size}"
    return {"step_shift": float(shift.max()), "step_note": note}
