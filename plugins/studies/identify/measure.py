"""Fits named parameters to records of the motion, by single shooting, multiple shooting and independent windows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from bench.errors import Unsupported, unknown
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.host.parameters import named
from bench.measure import noise, performance
from bench.model import (
    Answer,
    Decision,
    Identified,
    LoopOps,
    Optimizer,
    Rollout,
    State,
    compose,
    rollout,
)

from .. import norm
from . import START, Identify, adequacy
from .information import Information, product
from .record import evaluate, expressions, read

STEP = 1e-5
"""Step of central differences in the coordinates of unknowns. Its relative error is about 1e-10."""
SHOOTING = ("single", "multiple", "windows")
"""Shooting methods: one rollout, consecutive windows joined by a penalty on gaps, and independent windows."""
NOISE = 0.01
"""Noise of records that are made from the truth, if none is stated."""
CONVERGED = 1e-3
"""Remaining step of a converged fit, in standard errors by its residuals, and its square by the noise."""
SHARE = 1e-4
"""Exponents below this are 0."""
UNEXPLAINED = 1e-3
"""Share of fits to a right model whose residuals are larger than those that count as consistent with the noise."""

Push = Callable[[int, np.ndarray, np.ndarray], Any]
"""An acceleration as a function of step, q and v."""


def still(*_: Any) -> float:
    """Return no acceleration."""
    return 0.0


@dataclass(frozen=True)
class Model:
    """A program of which named parameters, and entries of its initial state, are estimated from measurements.

    Fits use one coordinate per unknown: the logarithm, or for an unknown with a ``scale`` its value over that.
    """

    program: Rollout
    names: tuple[str, ...]
    measured: tuple[int, ...]
    """Indices of the measured entries of the state (q, v)."""
    steps: tuple[int, ...]
    """Numbers of the steps after which the entries are measured, from 1."""
    state: Mapping[str, float] = field(default_factory=dict)
    """Entries of the initial state that are not those of the scene."""
    free: tuple[int, ...] = ()
    """Indices of the entries of the initial state that are unknown, after the parameters."""
    scale: np.ndarray = field(default_factory=lambda: np.zeros(1))
    """Scales of the unknowns that have no logarithm, ``(p,)``; 0: fitted by its logarithm."""

    @cached_property
    def values(self) -> np.ndarray:
        """The scene's own values of the unknowns, ``(p,)``."""
        theta = self.program.theta0
        return np.append(theta, self.initial_states(theta[:, None])[list(self.free), 0])

    @property
    def entries(self) -> list[str]:
        """The names of the entries of the state: q0, q1, v0, v1."""
        scene = self.program.scene
        return [f"q{i}" for i in range(scene.n_q)] + [f"v{i}" for i in range(scene.n_v)]

    @cached_property
    def unit(self) -> np.ndarray:
        """The largest size of each entry of the state along the scene's own motion, ``(n,)``."""
        path, _ = self.motion(self.values[:, None])
        return np.maximum(np.abs(path[1:]).max(axis=(0, 2)), 1e-6)

    def places(self, names: Collection[str]) -> tuple[int, ...]:
        """Return the indices of entries of the state; raises :class:`UserError` for an unknown one."""
        entries = self.entries
        for name in names:
            if name not in entries:
                raise unknown(f"entry of the state of scene {self.program.scene.name}:", name, entries)
        return tuple(map(entries.index, names))

    def theta(self, points: np.ndarray) -> np.ndarray:
        """Return the unknowns ``(p, B)`` of coordinates."""
        scale = self.scale[:, None]
        with np.errstate(over="ignore"):
            return np.where(scale, scale * points, np.exp(points))

    def points(self, theta: np.ndarray) -> np.ndarray:
        """Return the coordinates ``(p, B)`` of unknowns."""
        scale = self.scale[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(scale, theta / scale, np.log(theta))

    def scaled(self, theta: np.ndarray) -> Model:
        """Return the model with the sizes in ``theta (p,)`` as scales, where they change the motion noticeably."""
        # least size of an unknown without a logarithm, in units of its scale, that becomes its scale
        is_large = np.abs(theta) > 0.01 * np.abs(self.scale)
        return dataclasses.replace(self, scale=np.where(self.scale * is_large, theta, self.scale))

    def with_scales(self, start: np.ndarray) -> Model:
        """Return the model with a scale for each unknown that is no parameter with a positive value and ``start``.

        At a scale, the record differs from that of 0 by a hundredth of its size. An unknown that is not 0 is its own scale.
        """
        p = len(self.names)
        record = self.record(self.values[:, None] + STEP * np.eye(p, p + 1, 1))
        slopes = np.linalg.norm(record[:, 1:] - record[:, :1], axis=0) / STEP
        scale = 0.01 * (norm(record[:, 0]) or 1.0) / np.where(slopes > 0.0, slopes, 1.0)
        scale[: len(start)] *= np.minimum(self.values[: len(start)], start) <= 0.0
        return dataclasses.replace(self, scale=scale).scaled(self.values)

    def _start(self, theta: np.ndarray) -> tuple[Rollout, np.ndarray, State, tuple[np.ndarray, ...]]:
        w = np.zeros((self.program.n_noise, theta.shape[1]))
        program, own, w = self.program.resolved(LoopOps(), theta[: len(self.program.theta0)], w)
        own, state, scanned = program.start(LoopOps(), own, w)
        return program, own, state, scanned

    def initial_states(self, theta: np.ndarray) -> np.ndarray:
        """Return the initial states ``(n, B)`` for ``theta (p, B)``; entries that theta lacks are those of the scene."""
        states, own = np.concatenate(self._start(theta)[2]), len(self.program.theta0)
        states[list(self.places(self.state))] = np.reshape([*self.state.values()], (-1, 1))
        states[list(self.free[: len(theta) - own])] = theta[own:]
        return states

    def simulate(
        self, theta: np.ndarray, x: np.ndarray, begin: np.ndarray, steps: int, push: Push = still, nudge: Any = still
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the states ``(steps, n, B)`` after, and the controls in, each step from ``x (n, B)`` before ``begin (B,)``.

        ``push`` is an additional acceleration ``(n_v, B)`` of a step and state, half a step before and after each step,
        and ``nudge`` an additional control of a step.
        """
        program, own, state, scanned = self._start(theta)
        half = 0.5 * program.scene.dt
        n_q, columns = len(state.q), np.arange(theta.shape[1])
        now, states, controls = State(x[:n_q], x[n_q:]), [], []
        with np.errstate(all="ignore"):
            for s in range(steps):
                at = np.minimum(begin + s, program.scene.horizon - 1)
                u = program.control(LoopOps(), own, now, tuple(part[at, :, columns].T for part in scanned)) + nudge(s)
                now = program.step(LoopOps(), State(now.q, now.v + half * push(s, *now)), u)
                now = State(now.q, now.v + half * push(s + 1, *now))
                states.append(np.concatenate(now))
                controls.append(u)
        return np.stack(states), np.stack(controls)

    def motion(
        self, theta: np.ndarray, push: Push = still, nudge: Any = still, shift: Any = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the path ``(horizon + 1, n, B)`` of ``theta (p, B)`` from a start moved by ``shift``, and its controls."""
        origin = self.initial_states(theta) + shift
        begin = np.zeros(theta.shape[1], dtype=int)
        states, controls = self.simulate(theta, origin, begin, self.program.scene.horizon, push, nudge)
        return np.concatenate([origin[None], states]), controls

    def record(self, theta: np.ndarray, *changes: Any) -> np.ndarray:
        """Return the measurements ``(m, B)`` along whole rollouts of ``theta (p, B)``, see :meth:`motion`."""
        return self.measurements(self.motion(theta, *changes)[0][1:])

    def measurements(self, states: np.ndarray) -> np.ndarray:
        """Return the measurements ``(m, B)`` of the states ``(horizon, n, B)`` after each step."""
        return states[np.array(self.steps) - 1][:, list(self.measured)].reshape(-1, states.shape[2])


def model_of(cell: Cell, refinement: int = 1) -> Model:
    """Return the cell's model, with a time step ``refinement`` times shorter and the same measurements.

    Raises ValueError if an unknown entry of the initial state does not exist.
    """
    own: Any = cell.scene
    settings: Any = cell.study
    role: Any = own if isinstance(own, Identified) else Identified
    scene = dataclasses.replace(own, dt=own.dt / refinement, horizon=own.horizon * refinement)
    names = settings.decision(cell.decision).names or role.unknowns
    program = rollout(compose(scene, cell.contact, cell.integrator, Decision(names)))
    measured = role.measured or tuple(range(scene.n_q))
    first = own.horizon if role.end_only else 1
    steps = range(first * refinement, scene.horizon + 1, refinement)
    state = {entry: float(evaluate(text, {})) for entry, text in expressions(settings.state).items()}
    model = Model(program, names, measured, tuple(steps), state)
    starts = tuple(name for name in cell.decision.names if name.startswith(START))
    free = model.places([name.removeprefix(START) for name in starts])
    return dataclasses.replace(model, names=(*names, *starts), free=free).with_scales(
        program.theta0 if cell.decision.at is None else np.array(cell.decision.at)
    )


def own_record(path: str, settings: Identify, model: Model) -> tuple[Model, np.ndarray]:
    """Return the model with what the study's CSV file measures and when, and these measurements ``(m, 1)``.

    Raises ValueError, with the number of the first line that cannot be used.
    """
    scene, columns = model.program.scene, expressions(settings.measured)
    values, steps = read(path, columns, settings.time, scene.dt, settings.interpolate)
    measured = model.places(columns) or model.measured
    if len(values.columns) != len(measured):
        raise ValueError(
            f"{path} has {len(values.columns)} columns, scene {scene.name} is measured in {len(measured)} positions: name them, "
            "measured={{q0: angle*pi/180, v0: rate}}; numbers need decimal points"
        )
    times = tuple(steps.tolist()) if settings.time else model.steps
    if len(times) != len(values) or not times or not {*times} <= {*model.steps}:
        raise ValueError(
            f"{path} has {len(values)} lines up to step {max(steps, default=0)}, scene {scene.name} is "
            f"measured {len(model.steps)} times, up to step {model.steps[-1]}: set horizon"
        )
    return dataclasses.replace(model, measured=measured, steps=times), values.to_numpy().reshape(-1, 1)


# ----------------------------------------------------------------------------------------------- shooting methods


@dataclass(frozen=True)
class Fitting:
    """The residuals of a batch of fits by one shooting method.

    The unknowns are the model's coordinates, then the initial states of all windows but the first, divided by its ``unit``. A window of L steps is compared with the L samples after its start, the last one included: that is the
    sample at which the next window starts. Each sample of the record is compared exactly once.
    """

    model: Model
    shooting: str
    n_windows: int
    noise: float

    @property
    def dim(self) -> int:
        """Number of unknowns of a fit."""
        return len(self.model.names) + (self.n_windows - 1) * len(self.model.unit)

    @property
    def window_steps(self) -> int:
        """Number of steps of a window."""
        return self.model.program.scene.horizon // self.n_windows

    def residuals(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return residuals ``(m, B)`` of ``points (dim, B)`` against ``data (m', B)``, and of gaps, in units of the noise."""
        p, n, batch = len(self.model.names), len(self.model.unit), points.shape[1]
        theta = self.model.theta(points[:p])
        first = self.model.initial_states(theta)
        later = points[p:].reshape(self.n_windows - 1, n, batch) * self.model.unit[:, None]
        starts = np.concatenate([first[None], later])
        flat = np.moveaxis(starts, 0, 1).reshape(n, -1)  # columns ordered by window, then by fit
        begin = np.repeat(np.arange(self.n_windows) * self.window_steps, batch)
        states, _ = self.model.simulate(np.tile(theta, (1, self.n_windows)), flat, begin, self.window_steps)
        states = states.reshape(self.window_steps, n, self.n_windows, batch)
        path = np.moveaxis(states, 2, 0).reshape(self.n_windows * self.window_steps, n, batch)
        parts = [(self.model.measurements(path) - data) / self.noise]
        if self.shooting == "multiple":
            gaps = (states[-1, :, :-1] - np.moveaxis(later, 0, 1)).reshape(-1, batch)
            # weight of a gap between windows of multiple shooting, relative to the weight of a measurement
            parts.append(100.0 * gaps / self.noise)
        return np.concatenate(parts)

    def jacobians(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return the derivatives ``(m, dim, B)`` of the residuals by central differences."""
        batch = points.shape[1]
        shifts = STEP * np.repeat(np.eye(self.dim), batch, axis=1)
        wide, many = np.tile(points, (1, self.dim)), np.tile(data, (1, self.dim))
        change = self.residuals(wide + shifts, many) - self.residuals(wide - shifts, many)
        return change.reshape(len(change), self.dim, batch) / (2 * STEP)

    def start(self, theta: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return the initial unknowns ``(dim, B)`` for ``theta (p, B)`` and ``data (m', B)``.

        Windows after the first start at the measured positions and finite differences of them; in a first-order scene at
        the measured states. What is not measured starts on the rollout of theta.
        """
        model, batch, n = self.model, data.shape[1], len(self.model.unit)
        points = model.points(theta)
        if self.n_windows == 1:
            return points
        at = np.arange(1, self.n_windows) * self.window_steps
        states = model.motion(theta)[0][at]
        table, n_q = data.reshape(-1, len(model.measured), batch), model.program.scene.n_q
        slopes = np.gradient(table, model.program.scene.dt, axis=0)
        for column, entry in enumerate(model.measured if n in (n_q, 2 * n_q) or not n_q else ()):
            if entry < n_q:
                states[:, n_q + entry] = slopes[at - 1, column]
            states[:, entry] = table[at - 1, column]
        return np.concatenate([points, (states / model.unit[:, None]).reshape(-1, batch)])


def run_fits(
    fitting: Fitting, optimizer: Optimizer, start: np.ndarray, data: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the unknowns ``(dim, B)`` from ``start (dim, B)`` by an optimizer, and which fits have converged, ``(B,)``.

    A fit has converged, and stops, where its Gauss-Newton step is below :data:`CONVERGED` standard errors. All stop after
    ``iterations``.
    """
    states = [optimizer.start(column) for column in start.T]
    no_draws, has_converged = np.empty((fitting.dim, 0)), np.zeros(len(states), dtype=bool)
    for _ in range(iterations):
        active = np.flatnonzero(~has_converged)
        if not active.size:
            break
        queries = [optimizer.ask(states[i], no_draws) for i in active]
        counts = [points.shape[1] for points in queries]
        points, many = np.concatenate(queries, axis=1), np.repeat(data[:, active], counts, axis=1)
        ends = np.cumsum(counts)[:-1]
        residuals = np.split(fitting.residuals(points, many), ends, axis=1)
        slopes = np.split(fitting.jacobians(points, many), ends, axis=2)
        for i, query, own, slope in zip(active, queries, residuals, slopes, strict=True):
            gradient = np.einsum("mdb,mb->db", slope, own)
            answer = Answer(value=0.5 * (own**2).sum(axis=0), residual=own, jacobian=slope, gradient=gradient)
            states[i] = optimizer.tell(states[i], query, answer)
            is_finite = np.isfinite(own).all() and np.isfinite(slope).all()
            if is_finite and np.array_equal(states[i]["theta"], query[:, 0]):
                step = slope[:, :, 0] @ np.linalg.lstsq(slope[:, :, 0], own[:, 0], rcond=1e-8)[0]
                size = norm(own[:, 0]) / math.sqrt(len(own))
                has_converged[i] = np.linalg.norm(step) <= CONVERGED * max(size, CONVERGED)
    return np.stack([state["theta"] for state in states], axis=1), has_converged


def count_windows(horizon: int, most: int) -> int:
    """Return the largest number of equal windows, at most ``most``, with at least two steps each; 1 if there is none."""
    return max((n for n in range(1, most + 1) if horizon % n == 0 and horizon // n >= 2), default=1)


def prepared(cell: Cell, settings: Identify) -> tuple[Model, np.ndarray | None]:
    """Return the cell's model and the user's own measurements ``(m, 1)``, or None if records are made from the truth.

    Raises ValueError, :class:`UserError` or OSError for settings or a file that cannot be used.
    """
    model = model_of(cell)
    for text in expressions(settings.terms).values():
        evaluate(text, dict.fromkeys((*model.entries, "q", "v", "t"), np.zeros(2)))
    return (model, None) if settings.record is None else own_record(settings.record, settings, model)


def measure(cell: Cell, session: Session, settings: Identify) -> dict[str, Any]:
    """Return one cell's results by column: fits of all records by each shooting method, and the Cramer-Rao bound.

    Raises :class:`Unsupported` if a record without a stated noise has no more measurements than parameters.
    """
    optimizer: Any = cell.parts["optimizer"]
    model, measurements = prepared(cell, settings)
    is_own, data = measurements is not None, records(cell, settings) if measurements is None else measurements
    factor = np.where(np.arange(data.shape[1]) % 2 == 0, settings.start, 1.0 / settings.start)
    theta, start = model.values, model.values[:, None] * factor
    if cell.decision.at is not None:
        start[: len(cell.decision.at)] = np.array(cell.decision.at)[:, None]
    horizon = model.program.scene.horizon
    n_windows = count_windows(horizon, settings.windows)
    has_windows = len(model.steps) == horizon and n_windows > 1

    is_noise_known = settings.measurement is not None or not is_own

    def fit(shooting: str, sigma: float) -> Fit:
        fitting = Fitting(model, shooting, 1 if shooting == "single" else n_windows, sigma)
        fitted = run_fits(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
        return Fit(
            fitting, is_noise_known, *fitted, fitting.residuals(fitted[0], data), fitting.jacobians(fitted[0], data)
        )

    sigma = settings.measurement or (float(np.std(data)) or 1.0 if is_own else NOISE)
    if is_own:
        first, free = fit("single", sigma), len(data) - len(theta)
        if not is_noise_known and free < 1:
            raise Unsupported(
                f"{settings.record} has {len(data)} measurements for {len(theta)} unknowns: state the noise, measurement=.."
            )
        if not is_noise_known:
            sigma *= norm(first.residual) / math.sqrt(free) or 1.0
        theta = model.theta(first.solution)[:, 0]
        model = model.scaled(theta)
    single = fit("single", sigma)
    known = information(model, theta, sigma)
    result: dict[str, Any] = {
        "status": "ok",
        "reason": "",
        "rank": known.rank,
        "condition": known.condition,
        "fits": data.shape[1],
        "unknowns": list(model.names),
        "truth": [math.nan] * len(theta) if is_own else theta.tolist(),
        "invariants": known.labels,
        "bound": known.bound.tolist(),
        **step_dependence(cell, model, theta, known, sigma),
        **_estimates(single, known, start[:, 0], expressions(settings.terms)),
    }
    fits = [single, *(fit(shooting, sigma) for shooting in SHOOTING[1:] if has_windows)]
    result |= pd.DataFrame([_fit_statistics(one, known, is_own) for one in fits]).to_dict("list")
    return result


@dataclass(frozen=True)
class Fit:
    """Fits of all records by one shooting method."""

    fitting: Fitting
    is_noise_known: bool
    solution: np.ndarray
    """The unknowns, ``(dim, B)``."""
    has_converged: np.ndarray
    """Whether the optimizer has reached an optimum, ``(B,)``."""
    residual: np.ndarray
    jacobian: np.ndarray

    @property
    def is_finite(self) -> np.ndarray:
        """Whether residuals and derivatives are finite, ``(B,)``."""
        return np.isfinite(self.jacobian).all(axis=(0, 1)) & np.isfinite(self.residual).all(axis=0)

    def slopes(self, i: int) -> np.ndarray:
        """Return the Jacobian ``(m, p)`` of fit ``i`` by the parameters, with the windows' initial states projected out."""
        own, later = np.split(self.jacobian[:, :, i], [len(self.fitting.model.names)], axis=1)
        return own - later @ (np.linalg.pinv(later) @ own)


@dataclass(frozen=True)
class _Intervals:
    """Estimates of the invariants from the first record and their 95% intervals, each ``(rank,)``."""

    estimate: np.ndarray
    size: np.ndarray
    """The error of an estimate per error of its coordinate."""
    half: np.ndarray
    """Half the widths of the intervals of the coordinates."""
    low: np.ndarray
    high: np.ndarray
    noise: str
    """The noise that the intervals allow for."""


def _intervals(fit: Fit, known: Information, theta: np.ndarray) -> _Intervals:
    """Return the intervals for estimates ``theta (p,)`` of the parameters."""
    scale, invariants = fit.fitting.model.scale, known.invariants
    estimate, (half, kind) = _products(theta, invariants), _half_widths(fit, 0, known)
    size = np.abs(_products(np.where(scale, scale, theta), invariants))
    # an unknown without a logarithm has an interval of its own values
    is_linear = np.abs(invariants) @ (scale != 0.0) > SHARE
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = (
            np.where(is_linear, estimate + side * size * half, estimate * np.exp(side * half)) for side in (-1.0, 1.0)
        )
    return _Intervals(estimate, size, half, low, high, kind)


def _units(model: Model, names: tuple[str, ...]) -> dict[str, str]:
    """Return the units of unknowns; empty for entries of the initial state."""
    parts = [*map(type, model.program.parts.values())]
    return {name: (part.unit or "1") if (part := named(parts, name)) else "" for name in names}


def _estimates(fit: Fit, known: Information, start: np.ndarray, own: Mapping[str, str]) -> dict[str, Any]:
    """Return the first record's estimates, whether fits explain the records, and the biases that tests can miss.

    ``explained`` is the share of records that no test contradicts. The other columns belong to the first record.
    """
    model, invariants, p, rank = fit.fitting.model, known.invariants, len(known.names), known.rank
    theta = model.theta(fit.solution[:p, :1])[:, 0]
    # the invariants, then the parameters that are none
    names = list(dict.fromkeys([*known.labels, *known.names]))
    exponents = np.concatenate([invariants, np.eye(p)[[known.names.index(name) for name in names[rank:]]]])
    is_seen = (np.abs(exponents @ invariants.T) > SHARE).any(axis=1)
    units = _units(model, known.names)
    factors = tuple(f"({unit})" if {*unit} & {*" /"} else unit or "1" for unit in units.values())
    intervals, nothing = _intervals(fit, known, theta), [math.nan] * (len(names) - rank)
    result = {
        "parameter": names,
        "estimate": [*intervals.estimate, *nothing],
        "estimate_low": [*intervals.low, *nothing],
        "estimate_high": [*intervals.high, *nothing],
        "unit": [units.get(name, product(factors, row)) for name, row in zip(names, exponents, strict=True)],
        "start": _products(start, exponents).tolist(),
        "interval_noise": intervals.noise,
        "identifiable": ["yes" if k < rank else "product" if seen else "no" for k, seen in enumerate(is_seen)],
        "bias": [math.nan] * len(names),
        "biased": [],
        "term": [],
        "unnoticed": [],
        "errors": [],
    }
    # most records whose residuals are tested
    finite = np.flatnonzero(fit.is_finite)[:64].tolist()
    if not finite or finite[0]:
        return result
    # the effects of missing terms at one fit serve all records, which have the same truth
    terms = missing_terms(model, theta, fit.fitting.noise, own)
    verdicts = [
        adequacy.judge(
            fit.residual[:, i], known.along(fit.slopes(i)), len(model.measured), terms, i, fit.is_noise_known
        )
        for i in finite
    ]
    first = verdicts[0]
    result |= {
        "explained": float(np.mean([one.is_explained for one in verdicts])) + 0.0 * first.probability,  # nan: untested
        "contradictions": ", ".join(f"{name} ({value:.2g})" for name, value in first.contradictions.items()),
        "noise_size": fit.fitting.noise * norm(fit.residual[:, 0]) / math.sqrt(max(len(fit.residual) - rank, 1)),
    }
    if not first.reach:
        return result
    biases = _hidden_biases(fit, known, np.array([terms[name] for name in first.reach]), [*first.reach.values()])
    unnoticed = biases * intervals.size[:, None]
    return result | {
        "bias": [*unnoticed.max(axis=1, initial=0.0), *nothing],
        "biased": np.repeat(known.labels, len(first.reach)).tolist(),
        "term": [*first.reach] * rank,
        "unnoticed": unnoticed.ravel().tolist(),
        "errors": (biases * performance.Z / intervals.half[:, None]).ravel().tolist(),
    }


def _hidden_biases(fit: Fit, known: Information, effects: np.ndarray, reach: list[float]) -> np.ndarray:
    """Return the change of the invariants' coordinates ``(rank, k)`` by ``effects (k, m)`` of a size that tests just miss."""
    shares = np.abs(np.linalg.pinv(known.along(fit.slopes(0))) @ effects.T) / known.bound[:, None]
    is_moved = shares > adequacy.RESOLVED * shares.max(axis=0, initial=0.0)
    with np.errstate(invalid="ignore"):  # an effect that is all in one estimate moves no other
        return known.bound[:, None] * np.where(is_moved, shares * reach, 0.0)


def _half_widths(fit: Fit, i: int, known: Information) -> tuple[np.ndarray, str]:
    """Return half the widths of fit ``i``'s 95% intervals of the invariants' coordinates, and the noise they allow for."""
    if not fit.is_finite[i] or Information(known.names, fit.slopes(i)).rank < known.rank:
        return np.full(known.rank, np.inf), ""
    slopes = known.along(fit.slopes(i))
    if fit.fitting.shooting != "single":
        return performance.Z * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), ""
    channels = len(fit.fitting.model.measured)
    variance, kind, quantile = adequacy.variances(fit.residual[:, i], slopes, channels, fit.is_noise_known)
    return quantile * np.sqrt(variance), kind


TERMS = {
    "start": {"start": "1"},
    "acceleration": {
        "constant force": "1",
        "drag v|v|": "v*abs(v)",
        "drag v^3": "v**3",
        "dry friction": "sign(v)",
        "spring q^2": "q**2",
        "spring q^3": "q**3",
        "hysteresis": "hysteresis(q)",
    },
    "control": {"lag": "slope(x)", "dead zone": "sign(x)"},
    "sensor": {"offset": "1", "gain": "x", "drift": "t", "delay": "slope(x)"},
}
"""Effects that a model may lack by where they act, as expressions along the motion.

x is what they act on, q and v are the coordinate that they accelerate, q0, v0, ... the state, and t rises from -1 to 1.
"""


@dataclass(frozen=True)
class _Place:
    """Where an effect may act: a kind of :data:`TERMS`, what it acts on, and the course and the size of that."""

    kind: str
    of: str
    signal: np.ndarray
    size: float


def _places(model: Model, path: np.ndarray, controls: np.ndarray) -> list[_Place]:
    """Return the places along a motion: entries of the start, accelerations, controls and sensors."""
    scene, entries = model.program.scene, model.entries
    speeds, inputs = path[:, scene.n_q :], np.pad(controls, ((0, 1), (0, 0)), "edge")
    acceleration = np.abs(np.diff(speeds, axis=0)).max() / scene.dt

    def place(kind: str, of: str, signal: np.ndarray) -> _Place:
        return _Place(kind, of, signal, np.abs(signal).max())

    return [
        *(place("start", entry, signal) for entry, signal in zip(entries, path.T, strict=True)),
        *(_Place("acceleration", f"q{i}", signal, acceleration) for i, signal in enumerate(speeds.T)),
        *(place("control", f"u{i}", signal) for i, signal in enumerate(inputs.T)),
        *(place("sensor", f"sensor {entries[i]}", path[:, i]) for i in model.measured),
    ]


def _courses(place: _Place, state: Mapping[str, np.ndarray], own: Mapping[str, str]) -> dict[str, Any]:
    """Return the courses of the effects that may act in a place, by name; ``own`` are further accelerations."""
    known = {**state, "t": np.linspace(-1.0, 1.0, len(place.signal)), "x": place.signal}
    texts = TERMS[place.kind]
    if place.kind == "acceleration":
        axis = place.of[1:]
        texts = texts | {f"coupling with {entry}": entry for entry in state if entry[1:] != axis} | dict(own)
        known |= {"q": state[place.of], "v": state[f"v{axis}"]}
    return {f"{name} of {place.of}": evaluate(text, known) for name, text in texts.items()}


def missing_terms(
    model: Model, theta: np.ndarray, sigma: float, own: Mapping[str, str] | None = None
) -> dict[str, np.ndarray]:
    """Return the change of the standardised record ``(m,)`` per unit of effects that the model lacks, by name.

    The effects are :data:`TERMS`, accelerations in other coordinates, and the accelerations ``own``. They act along the
    motion of ``theta (p,)``, to first order. A scene whose velocities are not those of its positions has no accelerations.
    """
    path, controls = (part[:, :, 0] for part in model.motion(theta[:, None]))
    state, n_q = dict(zip(model.entries, path.T, strict=True)), model.program.scene.n_q
    places, n_v = _places(model, path, controls), len(state) - n_q
    acting = [
        (k, name, course)
        for k, place in enumerate(places)
        if place.kind != "acceleration" or n_v == n_q
        for name, course in _courses(place, state, own or {}).items()
    ]
    # of an effect when it is computed, relative to the largest value of what it acts on
    relative = 1e-4
    courses = np.zeros((len(path), len(places), len(acting)))
    for column, (k, _, course) in enumerate(acting):
        courses[:, k, column] = relative * places[k].size * course / (np.abs(course).max() or 1.0)
    ends = np.cumsum([len(state), n_v, controls.shape[1]])
    starts, pushes, nudges, sensors = np.split(np.concatenate([courses, -courses], axis=2), ends, axis=1)
    wide = np.repeat(theta[:, None], starts.shape[2], axis=1)
    moved = model.record(wide, lambda s, *_: pushes[s], lambda s: nudges[s], starts[0])
    seen = moved + sensors[np.array(model.steps)].reshape(moved.shape)
    up, down = np.split(seen / (2.0 * relative * sigma), 2, axis=1)
    free = {name.replace(".", " of ") for name in model.names}
    return {
        name: effect
        for (_, name, _), effect in zip(acting, (up - down).T, strict=True)
        if name not in free and np.isfinite(effect).all() and effect.any()
    }


def _products(theta: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Return products of powers ``(r,)`` of ``theta (p,)``, for exponents ``(r, p)``."""
    with np.errstate(all="ignore"):
        return np.prod(np.sign(theta) ** np.rint(exponents) * np.abs(theta) ** exponents, axis=1)


def _fit_statistics(fit: Fit, known: Information, is_own: bool) -> dict[str, Any]:
    """Return the entries of one shooting method."""
    p, n_fits, shooting, model = len(known.names), fit.solution.shape[1], fit.fitting.shooting, fit.fitting.model
    measured = len(model.steps) * len(model.measured)
    square = (fit.residual[:measured] ** 2).sum(axis=0)
    # gaps of multiple shooting tie its initial states to the parameters
    free = max(measured - (fit.fitting.dim if shooting == "windows" else p), 1)
    has_converged = np.isfinite(square) & (square <= chdtri(free, UNEXPLAINED))
    hidden = sum(
        Information(known.names, fit.slopes(i)).rank > known.rank for i in np.flatnonzero(fit.is_finite).tolist()
    )
    halves = np.stack([_half_widths(fit, i, known)[0] for i in range(n_fits)], axis=1)
    chosen = has_converged & np.isfinite(halves).all(axis=0) & (not is_own)
    apart = known.invariants @ (fit.solution[:p] - model.points(model.values[:, None]))
    errors = (apart / known.bound[:, None])[:, chosen]
    is_covered = (np.abs(apart) <= halves)[:, chosen]
    n_converged, coverage, interval = int(has_converged.sum()), math.nan, (math.nan, math.nan)
    if is_covered.size:
        coverage = float(is_covered.mean())
        # the sample size of this interval is the number of records: invariants of one record are dependent
        interval = performance.wilson(round(coverage * n_converged), n_converged)
    names = [f"{name}_{end}" for name in ("converged", "coverage") for end in ("low", "high")]
    return {
        "shooting": shooting,
        "optimum": float(fit.has_converged.mean()),
        "converged": n_converged / n_fits,
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors.size else math.nan,
        "coverage": coverage,
        "hidden": hidden,
        **dict(zip(names, (*performance.wilson(n_converged, n_fits), *interval), strict=True)),
    }


def information(model: Model, theta: np.ndarray, sigma: float) -> Information:
    """Return the Fisher information of a record of ``theta (p,)`` on the logarithms of its parameters, by single shooting.

    ``sigma`` is the standard deviation of a measurement's noise.
    """
    points = model.points(theta[:, None])
    fitting = Fitting(model, "single", 1, sigma)
    return Information(model.names, fitting.jacobians(points, model.record(theta[:, None]))[:, :, 0])


def records(cell: Cell, settings: Identify) -> np.ndarray:
    """Return ``repeats`` noisy records ``(m, B)`` of the true motion."""
    source = model_of(cell, settings.refine)
    clean = source.record(source.values[:, None])
    drawn = noise.draw(cell.seed, cell.scene.name, cell.repeats, 1, len(clean), "identify: measurements")[:, 0].T
    return clean + (settings.measurement or NOISE) * drawn


def step_dependence(cell: Cell, model: Model, theta: np.ndarray, known: Information, sigma: float) -> dict[str, float]:
    """Return the largest change of a noiseless fit when the model's step is halved: relative, and in units of its bound.

    To first order, it is the least-squares change of the parameters that compensates the change of the record.
    """
    steps = tuple(2 * step for step in model.steps)
    half = dataclasses.replace(model_of(cell, 2), measured=model.measured, steps=steps)
    change = (half.record(theta[:, None]) - model.record(theta[:, None]))[:, 0] / sigma
    if not known.rank or not np.isfinite(change).all():
        return {"step_shift": math.nan, "step_shift_bound": math.nan}
    shift = np.abs(np.linalg.pinv(known.along(known.jacobian)) @ change)
    return {"step_shift": float(shift.max()), "step_shift_bound": float((shift / known.bound).max())}
