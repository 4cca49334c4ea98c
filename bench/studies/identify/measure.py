"""Fits named parameters to records of the motion, by single shooting, multiple shooting and independent windows."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import adequacy, noise, performance
from bench.measure.identification import Information
from bench.model import Answer, Decision, Identified, LoopOps, MechanicalScene, Optimizer, Rollout, State, compose
from bench.model.parameters import Parameter, named
from bench.studies import norm
from bench.studies.identify import Identify

STEP = 1e-5
"""Step of central differences in the logarithms of parameters. Its relative error is about 1e-10."""
SHOOTING = ("single", "multiple", "windows")
"""Shooting methods: one rollout, consecutive windows joined by a penalty on gaps, and independent windows."""
GAP_WEIGHT = 100.0
"""Weight of a gap between windows of multiple shooting, relative to the weight of a measurement."""
NOISE = 0.01
"""Noise of records that are made from the truth, if none is stated."""
CONVERGED = 1e-3
"""Remaining step of a converged fit, in standard errors by its residuals, and its square by the noise."""
TESTED = 64
"""Most records whose residuals are tested."""
UNEXPLAINED = 1e-3
"""Share of fits to a right model whose residuals are larger than those that count as consistent with the noise."""

Push = Callable[[np.ndarray, np.ndarray], Any]
"""An acceleration as a function of q and v."""


def still(q: np.ndarray, v: np.ndarray) -> float:
    """Return no acceleration."""
    return 0.0


@dataclass(frozen=True)
class Model:
    """A program whose named parameters are estimated from measured positions."""

    program: Rollout
    names: tuple[str, ...]
    measured: tuple[int, ...]
    """Indices of the measured entries of the state (q, v)."""
    steps: tuple[int, ...]
    """Numbers of the steps after which positions are measured, from 1."""

    @property
    def values(self) -> np.ndarray:
        """The scene's own values of the parameters, ``(p,)``."""
        return self.program.theta0

    @property
    def parameters(self) -> list[Parameter]:
        """The declarations of the parameters."""
        found = [named(map(type, self.program.parts.values()), name) for name in self.names]
        return [parameter for parameter in found if parameter is not None]

    def _start(self, theta: np.ndarray) -> tuple[Rollout, np.ndarray, State, tuple[np.ndarray, ...]]:
        w = np.zeros((self.program.n_noise, theta.shape[1]))
        program, own, w = self.program.resolved(LoopOps(), theta, w)
        own, state, scanned = program.start(LoopOps(), own, w)
        return program, own, state, scanned

    def initial_states(self, theta: np.ndarray) -> np.ndarray:
        """Return the initial states ``(n, B)`` for ``theta (p, B)``."""
        return np.concatenate(self._start(theta)[2])

    def simulate(
        self, theta: np.ndarray, x: np.ndarray, begin: np.ndarray, steps: int, push: Push = still
    ) -> np.ndarray:
        """Return the states ``(steps, n, B)`` after each step, from ``x (n, B)`` before the steps ``begin (B,)``.

        ``push`` is an additional acceleration ``(n_v, B)`` of a state, half a step before and after each step.
        """
        program, own, state, scanned = self._start(theta)
        half = 0.5 * program.scene.dt
        n_q, columns = len(state.q), np.arange(theta.shape[1])
        now, states = State(x[:n_q], x[n_q:]), []
        with np.errstate(all="ignore"):
            for s in range(steps):
                at = np.minimum(begin + s, program.scene.horizon - 1)
                u = program.control(LoopOps(), own, now, tuple(part[at, :, columns].T for part in scanned))
                now = program.step(LoopOps(), State(now.q, now.v + half * push(*now)), u)
                now = State(now.q, now.v + half * push(*now))
                states.append(np.concatenate(now))
        return np.stack(states)

    def record(self, theta: np.ndarray, push: Push = still, shift: Any = 0.0) -> np.ndarray:
        """Return the measurements ``(m, B)`` along whole rollouts of ``theta (p, B)`` from a start moved by ``shift``."""
        begin, origin = np.zeros(theta.shape[1], dtype=int), self.initial_states(theta) + shift
        return self.measurements(self.simulate(theta, origin, begin, self.program.scene.horizon, push))

    def measurements(self, states: np.ndarray) -> np.ndarray:
        """Return the measurements ``(m, B)`` of the states ``(horizon, n, B)`` after each step."""
        measured: np.ndarray = states[np.array(self.steps) - 1][:, list(self.measured)]
        return measured.reshape(-1, states.shape[2])


def model_of(cell: Cell, refinement: int = 1) -> Model:
    """Return the cell's model, with a time step ``refinement`` times shorter and the same measurements.

    Raises :class:`Unsupported` if an unknown is not positive.
    """
    own = cell.scene
    assert isinstance(own, MechanicalScene)
    scene = dataclasses.replace(own, dt=own.dt / refinement, horizon=own.horizon * refinement)
    role = own if isinstance(own, Identified) else None
    names = cell.decision.names or (role.unknowns if role else ())
    program = compose(scene, cell.contact, cell.integrator, Decision(tuple(names)))
    assert isinstance(program, Rollout)
    if (program.theta0 <= 0).any():
        raise Unsupported(f"unknowns {list(names)} are {program.theta0.tolist()}: relative errors need positive values")
    measured = (role and role.measured) or tuple(range(scene.n_q))
    first = own.horizon if role and role.end_only else 1
    steps = range(first * refinement, scene.horizon + 1, refinement)
    return Model(program, tuple(names), measured, tuple(steps))


def read(settings: Identify, model: Model) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the measurements ``(m, 1)`` of the study's CSV file and the steps, from 1, after which they were made.

    With a column of time, lines may be missing, and lines before the first step are left out. Raises ValueError with the
    number of the first line that cannot be used.
    """
    path, scene = settings.data, model.program.scene
    words = pd.read_csv(
        path, header=None, dtype=str, keep_default_na=False, skip_blank_lines=False, skipinitialspace=True
    )
    table = words.apply(pd.to_numeric, errors="coerce")
    if table.iloc[0].isna().all():
        table = table[1:].set_axis(words.iloc[0], axis=1)
    names = settings.measured.split("+") if settings.measured else [c for c in table if c != settings.time]
    if lost := {*names, settings.time or names[0]} - {*table}:
        raise ValueError(f"{path} has no column {min(lost)}; its columns are {', '.join(map(str, table))}")
    wrong = ~np.isfinite(table[[settings.time or names[0], *names]]).all(axis=1)
    if wrong.any():
        line = wrong.idxmax()
        raise ValueError(f"{path}, line {line + 1}: {words.loc[line].tolist()} are not finite numbers")
    if len(names) != len(model.measured):
        raise ValueError(
            f"{path} has {len(names)} columns, scene {scene.name} is measured in {len(model.measured)} positions: name them, "
            "measured=a+b; numbers need decimal points"
        )
    values, steps = table[names].to_numpy(), np.array(model.steps)
    if settings.time:
        times = table[settings.time].to_numpy() / scene.dt
        steps = np.rint(times).astype(int)
        wrong = (np.abs(times - steps) > 0.01) | (np.diff(steps, prepend=steps[:1] - 1) < 1)
        if wrong.any():
            raise ValueError(
                f"{path}, line {table.index[wrong][0] + 1}: its time is not a later multiple of scene {scene.name}'s dt={scene.dt:g}"
            )
        values, steps = values[steps > 0], steps[steps > 0]
    if len(values) != len(steps) or not values.size or not {*steps} <= {*model.steps}:
        raise ValueError(
            f"{path} has {len(values)} lines{f' up to step {max(steps, default=0)}' * bool(settings.time)}, scene {scene.name} is "
            f"measured {len(model.steps)} times, up to step {model.steps[-1]}: set horizon"
        )
    for name, column in zip(names, values.T, strict=True):
        if len(column) > 1 and np.ptp(column) == 0.0:
            raise ValueError(f"{path}: column {name} is constant")
    return values.reshape(-1, 1), tuple(steps.tolist())


# ----------------------------------------------------------------------------------------------- shooting methods


@dataclass(frozen=True)
class Fitting:
    """The residuals of a batch of fits by one shooting method.

    The unknowns are the logarithms of the parameters, then the initial states of all windows but the first, divided by
    ``unit``. A window of L steps is compared with the L samples after its start, the last one included: that is the
    sample at which the next window starts. Each sample of the record is compared exactly once.
    """

    model: Model
    shooting: str
    n_windows: int
    noise: float
    unit: np.ndarray
    """Scale of the states, ``(n,)``."""

    @property
    def dim(self) -> int:
        """Number of unknowns of a fit."""
        return len(self.model.names) + (self.n_windows - 1) * len(self.unit)

    @property
    def window_steps(self) -> int:
        """Number of steps of a window."""
        return self.model.program.scene.horizon // self.n_windows

    def residuals(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return residuals ``(m, B)`` of ``points (dim, B)`` against ``data (m', B)``, and of gaps, in units of the noise."""
        p = len(self.model.names)
        return self.residuals_at(np.exp(points[:p]), points[p:], data)

    def residuals_at(self, theta: np.ndarray, starts_later: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return :meth:`residuals` of parameters ``theta (p, B)`` themselves and of the other unknowns ``(dim - p, B)``."""
        batch, n = theta.shape[1], len(self.unit)
        first = self.model.initial_states(theta)
        later = starts_later.reshape(self.n_windows - 1, n, batch) * self.unit[:, None]
        starts = np.concatenate([first[None], later])
        flat = np.moveaxis(starts, 0, 1).reshape(n, -1)  # columns ordered by window, then by fit
        begin = np.repeat(np.arange(self.n_windows) * self.window_steps, batch)
        states = self.model.simulate(np.tile(theta, (1, self.n_windows)), flat, begin, self.window_steps)
        states = states.reshape(self.window_steps, n, self.n_windows, batch)
        path = np.moveaxis(states, 2, 0).reshape(self.n_windows * self.window_steps, n, batch)
        parts = [(self.model.measurements(path) - data) / self.noise]
        if self.shooting == "multiple":
            gaps = (states[-1, :, :-1] - np.moveaxis(later, 0, 1)).reshape(-1, batch)
            parts.append(GAP_WEIGHT * gaps / self.noise)
        return np.concatenate(parts)

    def jacobians(self, points: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return the derivatives ``(m, dim, B)`` of the residuals by central differences."""
        batch = points.shape[1]
        shifts = STEP * np.repeat(np.eye(self.dim), batch, axis=1)
        wide, many = np.tile(points, (1, self.dim)), np.tile(data, (1, self.dim))
        change = self.residuals(wide + shifts, many) - self.residuals(wide - shifts, many)
        return np.asarray(change.reshape(len(change), self.dim, batch) / (2 * STEP))

    def start(self, theta: np.ndarray, data: np.ndarray) -> np.ndarray:
        """Return the initial unknowns ``(dim, B)`` for ``theta (p, B)`` and ``data (m', B)``.

        Windows after the first start at the measured positions and finite differences of them; in a first-order scene at
        the measured states. What is not measured starts on the rollout of theta.
        """
        batch, n = data.shape[1], len(self.unit)
        states = np.zeros((self.n_windows - 1, n, batch))
        if self.n_windows > 1:
            begin = np.zeros(batch, dtype=int)
            steps = self.window_steps * self.n_windows
            rollout = self.model.simulate(theta, self.model.initial_states(theta), begin, steps)
            at = np.arange(1, self.n_windows) * self.window_steps
            states[:] = rollout[at - 1]
            table = data.reshape(-1, len(self.model.measured), batch)
            n_q, dt = self.model.program.scene.n_q, self.model.program.scene.dt
            for column, coordinate in enumerate(self.model.measured if n_q == 0 or n == 2 * n_q else ()):
                states[:, coordinate] = table[at - 1, column]
                if n_q:
                    states[:, n_q + coordinate] = (table[at, column] - table[at - 2, column]) / (2 * dt)
        return np.concatenate([np.log(theta), (states / self.unit[:, None]).reshape(-1, batch)])


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
        residual, jacobian = fitting.residuals(points, many), fitting.jacobians(points, many)
        ends = np.cumsum([0, *counts])
        for i, query, (low, high) in zip(active, queries, itertools.pairwise(ends), strict=True):
            own = residual[:, low:high]
            slope = jacobian[:, :, low:high]
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


def measure(cell: Cell, session: Session, settings: Identify) -> dict[str, Any]:
    """Return one cell's results by column: fits of all records by each shooting method, and the Cramer-Rao bound.

    Raises :class:`Unsupported` if a record without a stated noise has no more measurements than parameters.
    """
    optimizer = cell.parts["optimizer"]
    assert isinstance(optimizer, Optimizer)
    model, is_own = model_of(cell), settings.data is not None
    if is_own:
        data, steps = read(settings, model)
        model = dataclasses.replace(model, steps=steps)
    else:
        data = records(cell, settings)
    factor = np.where(np.arange(data.shape[1]) % 2 == 0, settings.start, 1.0 / settings.start)
    start = model.values[:, None] * factor[None, :]
    if cell.decision.at is not None:
        start = np.repeat(np.array(cell.decision.at)[:, None], data.shape[1], axis=1)
    horizon = model.program.scene.horizon
    n_windows = count_windows(horizon, settings.windows)
    has_windows = len(model.steps) == horizon and n_windows > 1

    def fit(shooting: str, sigma: float) -> Fit:
        fitting = Fitting(model, shooting, 1 if shooting == "single" else n_windows, sigma, _unit(model))
        fitted = run_fits(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
        return Fit(fitting, *fitted, fitting.residuals(fitted[0], data), fitting.jacobians(fitted[0], data))

    is_noise_known = settings.measurement is not None or not is_own
    sigma = settings.measurement or (float(np.std(data)) or 1.0 if is_own else NOISE)
    single = fit("single", sigma)
    if not is_noise_known:
        free = len(data) - len(model.names)
        if free < 1:
            raise Unsupported(
                f"{settings.data} has {len(data)} measurements for {len(model.names)} unknowns: state the noise, measurement=.."
            )
        sigma *= norm(single.residual) / math.sqrt(free) or 1.0
        single = fit("single", sigma)
    theta = np.exp(single.solution[:, 0]) if is_own else model.values
    known = information(model, theta, sigma)
    result: dict[str, Any] = {
        "status": "ok", "reason": "", "rank": known.rank, "condition": known.condition, "fits": data.shape[1],
        "unknowns": list(model.names), "units": [parameter.unit for parameter in model.parameters],
        "truth": [math.nan] * len(theta) if is_own else theta.tolist(), "start": start[:, 0].tolist(),
        "invariants": known.labels, "exponents": known.invariants.ravel().tolist(),
        "bound": known.bound.tolist(), "fisher": known.fisher.ravel().tolist(),
        **step_dependence(cell, model, theta, known, sigma), **_explanation(model, single, known, is_noise_known),
    }  # fmt: skip
    fits = [single, *(fit(shooting, sigma) for shooting in SHOOTING[1:] if has_windows)]
    found = [_fit_statistics(one, known, is_own, is_noise_known) for one in fits]
    lines = {name: np.concatenate([np.atleast_1d(one[name]) for one in found]).tolist() for name in found[0]}
    if settings.scan:
        lines |= scan(model, n_windows if has_windows else 1, data[:, :1], sigma, settings)
    return result | lines


@dataclass(frozen=True)
class Fit:
    """Fits of all records by one shooting method."""

    fitting: Fitting
    solution: np.ndarray
    """The unknowns, ``(dim, B)``."""
    has_converged: np.ndarray
    """Whether the optimizer has reached an optimum, ``(B,)``."""
    residual: np.ndarray
    jacobian: np.ndarray

    @property
    def is_finite(self) -> np.ndarray:
        """Whether residuals and derivatives are finite, ``(B,)``."""
        return np.asarray(np.isfinite(self.jacobian).all(axis=(0, 1)) & np.isfinite(self.residual).all(axis=0))

    def slopes(self, i: int) -> np.ndarray:
        """Return the Jacobian ``(m, p)`` of fit ``i`` by the parameters, with the windows' initial states projected out."""
        own, later = np.split(self.jacobian[:, :, i], [len(self.fitting.model.names)], axis=1)
        return np.asarray(own - later @ (np.linalg.pinv(later) @ own))


def _unit(model: Model) -> np.ndarray:
    """Return the largest size of each entry of the state along the scene's own motion, ``(n,)``."""
    theta = model.values[:, None]
    states = model.simulate(theta, model.initial_states(theta), np.zeros(1, dtype=int), model.program.scene.horizon)
    return np.asarray(np.maximum(np.abs(states).max(axis=(0, 2)), 1e-6))


def scan(model: Model, n_windows: int, data: np.ndarray, sigma: float, settings: Identify) -> dict[str, list[Any]]:
    """Return the loss of one record ``data (m, 1)`` along each unknown, and how many local minima it has.

    ``scan`` equally spaced values from the truth over ``span`` to the truth times ``span``, within the parameter's
    declared bounds, with all other unknowns at the truth. The loss is the mean square of the residuals in units of the
    noise, for the whole record and for independent windows: the fit's own, and others twice, four times, ... as long.
    Windows start where fits start them, at the measurements. ``minima`` counts the grid's inner points whose loss is
    below that of both neighbours; ``minima_open`` does it without the last sample of each window, see :class:`Fitting`.
    """
    counts = [1]
    while n_windows > 1:
        counts.insert(1, n_windows)
        n_windows = n_windows // 2 if n_windows % 2 == 0 else 1
    horizon, steps = model.program.scene.horizon, np.repeat(model.steps, len(model.measured))
    result: dict[str, list[Any]] = {
        "scan_steps": [horizon // count for count in counts], "scan_low": [], "scan_high": [],
        "minima": [], "minima_open": [], "scan_loss": [],
    }  # fmt: skip
    for i, (value, parameter) in enumerate(zip(model.values, model.parameters, strict=True)):
        ends = np.clip([value / settings.span, value * settings.span], parameter.low, parameter.high)
        low, high = ends.tolist()
        theta = np.repeat(model.values[:, None], settings.scan, axis=1)
        theta[i] = np.linspace(low, high, settings.scan)
        result["scan_low"].append(low)
        result["scan_high"].append(high)
        for count in counts:
            unit = np.ones(len(model.initial_states(theta[:, :1])))
            fitting = Fitting(model, "windows", count, sigma, unit)
            start = fitting.start(model.values[:, None], data)[len(theta) :]
            with np.errstate(all="ignore"):
                square = np.square(fitting.residuals_at(theta, np.repeat(start, settings.scan, axis=1), data))
            inner = steps % (horizon // count) != 0
            loss = square.mean(axis=0)
            result["minima"].append(int(is_minimum(loss).sum()))
            result["minima_open"].append(int(is_minimum(square[inner].mean(axis=0)).sum()) if inner.any() else math.nan)
            result["scan_loss"].extend(loss.tolist())
    return result


def is_minimum(values: np.ndarray) -> np.ndarray:
    """Return which values are below both of their neighbours; the first and the last are not.

    >>> is_minimum(np.array([2.0, 1.0, 2.0, 2.0, 0.0, 1.0, 0.5])).nonzero()[0].tolist()
    [1, 4]
    """
    inner = values[1:-1]
    return np.concatenate([[False], (inner < values[:-2]) & (inner < values[2:]), [False]])


def _explanation(model: Model, fit: Fit, known: Information, is_noise_known: bool) -> dict[str, Any]:
    """Return whether the fits by single shooting explain the records, and the biases that tests of them can miss.

    ``explained`` is the share of records that no test contradicts. The other columns belong to the first record.
    """
    residual, sigma = fit.residual, fit.fitting.noise
    finite = np.flatnonzero(fit.is_finite)[:TESTED].tolist()
    if not finite or finite[0] or not known.rank:
        return {"terms": [], "unnoticed": []}
    # the effects of missing terms at one fit serve all records, which have the same truth
    terms = missing_terms(model, np.exp(fit.solution[:, 0]), sigma)
    verdicts = [
        adequacy.judge(residual[:, i], known.along(fit.slopes(i)), len(model.measured), terms, i, is_noise_known)
        for i in finite
    ]
    first, free = verdicts[0], max(len(residual) - known.rank, 1)
    effects = np.array([terms[name] for name in first.reach]).reshape(-1, len(residual))
    biases = np.abs(np.linalg.pinv(known.along(fit.slopes(0))) @ effects.T) * np.array(list(first.reach.values()))
    return {
        "explained": float(np.mean([one.is_explained for one in verdicts])) + 0.0 * first.probability,  # nan: untested
        "contradictions": ", ".join(f"{name} ({value:.2g})" for name, value in first.contradictions.items()),
        "noise_size": sigma * norm(residual[:, 0]) / math.sqrt(free), "misfit": first.probability,
        "terms": list(first.reach), "unnoticed": biases.ravel().tolist(),
    }  # fmt: skip


def missing_terms(model: Model, theta: np.ndarray, sigma: float) -> dict[str, np.ndarray]:
    """Return the change of the standardised record ``(m,)`` per unit of effects that the model lacks, by name.

    The effects are an offset, gain, drift and delay of each sensor, the start of each entry of the state, and accelerations
    of each coordinate: constant, quadratic, cubic and signed in its velocity and position, and linear in other positions.
    They are computed at ``theta (p,)`` by central differences.
    """
    scene = model.program.scene
    channels, columns = len(model.measured), theta[:, None]
    plain = model.record(columns)[:, 0]
    terms = {}
    times = np.array(model.steps, dtype=float)
    table = plain.reshape(-1, channels)
    faults = {"offset": np.ones_like(table), "gain": table}
    if len(times) > 1:
        faults["drift"] = np.repeat((2.0 * times / times[-1] - 1.0)[:, None], channels, axis=1)
        faults["delay"] = -np.gradient(table, times, axis=0)
    for c, coordinate in enumerate(model.measured):
        for name, effect in faults.items():
            terms[f"{name} of sensor {coordinate}"] = (effect * np.eye(channels)[c]).ravel() / sigma
    begin = np.zeros(1, dtype=int)
    states = model.simulate(columns, model.initial_states(columns), begin, scene.horizon)[:, :, 0]
    largest, n_q = np.maximum(np.abs(states).max(axis=0), 1e-12), scene.n_q

    def moved(by: float, shift: Any, force: Any, effect: Push) -> np.ndarray:
        return model.record(columns, lambda q, v: by * force * effect(q, v), by * shift)[:, 0]

    def change(*by: Any) -> np.ndarray:
        return np.asarray((moved(RELATIVE, *by) - moved(-RELATIVE, *by)) / (2.0 * RELATIVE * sigma))

    for j, unit in enumerate(np.diag(largest)[:, :, None]):
        terms[f"start of {'v' if j >= n_q else 'q'}{j % max(n_q, 1)}"] = change(unit, 0.0, still)
    size = max(float(np.abs(np.diff(states[:, n_q:], axis=0)).max(initial=0.0)) / scene.dt, 1e-12)
    for i in range(n_q if len(largest) == 2 * n_q else 0):
        force = size * np.eye(n_q)[:, i : i + 1]
        terms |= {
            name: change(0.0, force, effect) for name, effect in _effects(i, largest[:n_q], largest[n_q + i]).items()
        }
    return {name: effect for name, effect in terms.items() if np.isfinite(effect).all() and effect.any()}


RELATIVE = 1e-4
"""Size of a missing acceleration whose effect is computed, relative to the largest acceleration of the motion."""


def _effects(i: int, x: np.ndarray, v: float) -> dict[str, Any]:
    """Return accelerations of coordinate ``i`` as functions of q and v, scaled by the largest positions ``x`` and velocity v."""
    of = f"of coordinate {i}"
    return {
        f"constant force {of}": lambda q, r: 1.0 + 0.0 * q[i],
        f"drag {of} in v|v|": lambda q, r: r[i] * np.abs(r[i]) / v**2,
        f"drag {of} in v^3": lambda q, r: (r[i] / v) ** 3,
        f"friction {of} in the sign of v": lambda q, r: np.tanh(100.0 * r[i] / v),
        f"spring {of} in q^2": lambda q, r: (q[i] / x[i]) ** 2,
        f"spring {of} in q^3": lambda q, r: (q[i] / x[i]) ** 3,
    } | {
        f"coupling {of} with {j}": lambda q, r, j=j: q[j] / x[j] for j in range(len(x)) if j != i
    }  # fmt: skip


def _fit_statistics(fit: Fit, known: Information, is_own: bool, is_noise_known: bool) -> dict[str, Any]:
    """Return the entries of one shooting method in columns of lists."""
    p, n_fits, shooting = len(known.names), fit.solution.shape[1], fit.fitting.shooting
    measured = len(fit.fitting.model.steps) * len(fit.fitting.model.measured)
    square = (fit.residual[:measured] ** 2).sum(axis=0)
    # gaps of multiple shooting tie its initial states to the parameters
    free = max(measured - (fit.fitting.dim if shooting == "windows" else p), 1)
    has_converged = np.isfinite(square) & (square <= chdtri(free, UNEXPLAINED))
    logs = known.invariants @ fit.solution[:p]
    halves, noises, hidden = np.full_like(logs, np.nan), [""] * n_fits, 0
    for i in np.flatnonzero(fit.is_finite).tolist():
        rank = Information(known.names, fit.slopes(i)).rank
        hidden += rank > known.rank
        slopes, channels = known.along(fit.slopes(i)), len(fit.fitting.model.measured)
        if rank < known.rank:
            halves[:, i] = np.inf
        elif shooting == "single":
            variance, noises[i], quantile = adequacy.variances(fit.residual[:, i], slopes, channels, is_noise_known)
            halves[:, i] = quantile * np.sqrt(variance)
        else:
            halves[:, i] = performance.Z * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    chosen = has_converged & np.isfinite(halves).all(axis=0) & (not is_own)
    apart = logs - (known.invariants @ np.log(fit.fitting.model.values))[:, None]
    errors = (apart / known.bound[:, None])[:, chosen]
    is_covered = (np.abs(apart) <= halves)[:, chosen]
    n_converged, coverage, interval = int(has_converged.sum()), math.nan, (math.nan, math.nan)
    low, high = performance.wilson(n_converged, n_fits)
    if is_covered.size:
        coverage = float(is_covered.mean())
        # the sample size of this interval is the number of records: invariants of one record are dependent
        interval = performance.wilson(round(coverage * n_converged), n_converged)
    with np.errstate(over="ignore"):
        ends = [np.exp(logs[:, 0] + side * halves[:, 0]).tolist() for side in (-1.0, 1.0)]
    return {
        "shooting": shooting, "optimum": float(fit.has_converged.mean()),
        "converged": n_converged / n_fits, "converged_low": low, "converged_high": high,
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors.size else math.nan,
        "coverage": coverage, "coverage_low": interval[0], "coverage_high": interval[1], "hidden": hidden,
        "estimate": np.exp(logs[:, 0]).tolist(), "estimate_low": ends[0], "estimate_high": ends[1],
        "intervals": noises[0],
    }  # fmt: skip


def information(model: Model, theta: np.ndarray, sigma: float) -> Information:
    """Return the Fisher information of a record of ``theta (p,)`` on the logarithms of its parameters, by single shooting.

    ``sigma`` is the standard deviation of a measurement's noise.
    """
    points = np.log(theta)[:, None]
    fitting = Fitting(model, "single", 1, sigma, np.ones(len(model.initial_states(theta[:, None]))))
    return Information(model.names, fitting.jacobians(points, model.record(theta[:, None]))[:, :, 0])


def records(cell: Cell, settings: Identify) -> np.ndarray:
    """Return ``repeats`` noisy records ``(m, B)`` of the true motion."""
    source = model_of(cell, settings.refine)
    clean = source.record(source.values[:, None])
    drawn = noise.draw(cell.seed, cell.scene.name, cell.repeats, 1, len(clean), "identify: measurements")[:, 0].T
    return np.asarray(clean + (settings.measurement or NOISE) * drawn)


def step_dependence(cell: Cell, model: Model, theta: np.ndarray, known: Information, sigma: float) -> dict[str, float]:
    """Return the largest change of a noiseless fit when the model's step is halved: relative, and in units of its bound.

    To first order, it is the least-squares change of the parameters that compensates the change of the record.
    """
    half = dataclasses.replace(model_of(cell, 2), steps=tuple(2 * step for step in model.steps))
    change = (half.record(theta[:, None]) - model.record(theta[:, None]))[:, 0] / sigma
    if not known.rank or not np.isfinite(change).all():
        return {"step_shift": math.nan, "step_shift_bound": math.nan}
    shift = np.abs(np.linalg.pinv(known.along(known.jacobian)) @ change)
    return {"step_shift": float(shift.max()), "step_shift_bound": float((shift / known.bound).max())}
