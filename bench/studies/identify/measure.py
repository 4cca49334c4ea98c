"""Fits named parameters to records of the motion, by single shooting, multiple shooting and independent windows."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.measure import adequacy, noise, performance
from bench.measure.identification import Information
from bench.model import Answer, Decision, Identified, LoopOps, MechanicalScene, Optimizer, Rollout, State, compose
from bench.model.parameters import named

STEP = 1e-5
"""Step of central differences in the logarithms of parameters. Its relative error is about 1e-10."""
SHOOTING = ("single", "multiple", "windows")
"""Shooting methods: one rollout, consecutive windows joined by a penalty on gaps, and independent windows."""
GAP_WEIGHT = 100.0
"""Weight of a gap between windows of multiple shooting, relative to the weight of a measurement."""
MAX_STEP_SHIFT = 0.5
"""Largest change of an estimate at half the step, in Cramer-Rao bounds, that counts as independent of the step.

To first order in the step, the error of the estimate is twice this change: one bound. With a bias of one bound, 17% of
the 95% intervals miss the truth instead of 5%.
"""

TESTED = 64
"""Most records whose residuals are tested."""
UNEXPLAINED = 1e-3
"""Share of fits to a right model whose residuals are larger than those that count as consistent with the noise."""
APART = 0.01
"""Share of records of a right model whose fits by single shooting and by windows count as different."""

Settings = Any
"""An ``Identify`` study: its parameters are the settings. Its module imports this module, so its type cannot be named."""


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

    def _start(self, theta: np.ndarray) -> tuple[Rollout, np.ndarray, State, tuple[np.ndarray, ...]]:
        w = np.zeros((self.program.n_noise, theta.shape[1]))
        program, own, w = self.program.resolved(LoopOps(), theta, w)
        own, state, scanned = program.start(LoopOps(), own, w)
        return program, own, state, scanned

    def initial_states(self, theta: np.ndarray) -> np.ndarray:
        """Return the initial states ``(n, B)`` for ``theta (p, B)``."""
        return np.concatenate(self._start(theta)[2])

    def simulate(self, theta: np.ndarray, x: np.ndarray, begin: np.ndarray, steps: int) -> np.ndarray:
        """Return the states ``(steps, n, B)`` after each step, from ``x (n, B)`` before the steps ``begin (B,)``."""
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
        """Return the measurements ``(m, B)`` along whole rollouts of ``theta (p, B)``."""
        begin = np.zeros(theta.shape[1], dtype=int)
        return self.measurements(self.simulate(theta, self.initial_states(theta), begin, self.program.scene.horizon))

    def measurements(self, states: np.ndarray) -> np.ndarray:
        """Return the measurements ``(m, B)`` of the states ``(horizon, n, B)`` after each step."""
        measured: np.ndarray = states[np.array(self.steps) - 1][:, list(self.measured)]
        return measured.reshape(-1, states.shape[2])


def model_of(cell: Cell, scene: MechanicalScene | None = None, refinement: int = 1) -> Model:
    """Return the cell's model. ``scene`` may be the cell's scene with a step ``refinement`` times shorter.

    Raises :class:`Unsupported` if an unknown is not positive.
    """
    own = cell.scene
    assert isinstance(own, MechanicalScene)
    scene = scene or own
    names = cell.decision.names or (own.unknowns if isinstance(own, Identified) else ())
    program = compose(scene, cell.contact, cell.integrator, Decision(tuple(names)))
    assert isinstance(program, Rollout)
    if (program.theta0 <= 0).any():
        raise Unsupported(f"unknowns {list(names)} are {program.theta0.tolist()}: relative errors need positive values")
    measured = own.measured if isinstance(own, Identified) else None
    coordinates = tuple(range(scene.n_q)) if measured is None else measured
    last = own.horizon
    steps = (last,) if isinstance(own, Identified) and own.end_only else tuple(range(1, last + 1))
    return Model(program, tuple(names), coordinates, tuple(refinement * step for step in steps))


def refine(scene: MechanicalScene, times: int) -> MechanicalScene:
    """Return the scene with the same duration and a time step ``times`` times shorter."""
    return dataclasses.replace(scene, dt=scene.dt / times, horizon=scene.horizon * times)


def read(path: str, scene: MechanicalScene) -> np.ndarray:
    """Return the measurements ``(m,)`` of a CSV file with a line per measured step.

    Raises ValueError if the number of lines or columns does not match the scene, or a number is not finite.
    """
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
) -> np.ndarray:
    """Return the unknowns ``(dim, B)`` after ``iterations`` of an optimizer from ``start (dim, B)``, as one batch."""
    states = [optimizer.start(column) for column in start.T]
    no_draws = np.empty((fitting.dim, 0))
    for _ in range(iterations):
        queries = [optimizer.ask(state, no_draws) for state in states]
        counts = [points.shape[1] for points in queries]
        points, many = np.concatenate(queries, axis=1), np.repeat(data, counts, axis=1)
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
            states[i] = optimizer.tell(states[i], queries[i], answer)
    return np.stack([state["theta"] for state in states], axis=1)


def count_windows(horizon: int, most: int) -> int:
    """Return the largest number of equal windows, at most ``most``, with at least two steps each; 1 if there is none."""
    return max((n for n in range(1, most + 1) if horizon % n == 0 and horizon // n >= 2), default=1)


def measure(cell: Cell, settings: Settings) -> dict[str, Any]:
    """Return one cell's results by column: fits of all records by each shooting method, and the Cramer-Rao bound."""
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
    result |= _explanation(cell, model, optimizer, start, data, settings)
    lines: dict[str, list[Any]] = {name: [] for name in LISTS}
    n_windows = count_windows(scene.horizon, settings.windows)
    has_windows = len(model.steps) == scene.horizon and n_windows > 1
    for shooting in SHOOTING if has_windows else SHOOTING[:1]:
        for name, value in _fit_statistics(model, shooting, n_windows, optimizer, start, data, known, settings).items():
            lines[name].extend(value if isinstance(value, list) else [value])
    if has_windows and (apart := _difference_of_fits(lines, known)):
        result["reason"] = "; ".join(part for part in (result["reason"], apart) if part)
    if settings.scan:
        lines |= scan(model, n_windows if has_windows else 1, data[:, :1], settings)
    return result | lines


def scan(model: Model, n_windows: int, data: np.ndarray, settings: Settings) -> dict[str, list[Any]]:
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
    for i, (low, high) in enumerate(_ranges(model, settings.span)):
        theta = np.repeat(model.values[:, None], settings.scan, axis=1)
        theta[i] = np.linspace(low, high, settings.scan)
        result["scan_low"].append(low)
        result["scan_high"].append(high)
        for count in counts:
            unit = np.ones(len(model.initial_states(theta[:, :1])))
            fitting = Fitting(model, "windows", count, settings.measurement, unit)
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


def _ranges(model: Model, span: float) -> list[tuple[float, float]]:
    """Return the ends of the scan of each unknown: the truth over and times ``span``, within the declared bounds."""
    ranges = []
    for name, value in zip(model.names, model.values.tolist(), strict=True):
        declared = named(map(type, model.program.parts.values()), name)
        assert declared is not None
        low = value / span if declared.low is None else max(value / span, declared.low)
        high = value * span if declared.high is None else min(value * span, declared.high)
        ranges.append((low, high))
    return ranges


def _explanation(
    cell: Cell, model: Model, optimizer: Optimizer, start: np.ndarray, data: np.ndarray, settings: Settings
) -> dict[str, Any]:
    """Return whether the fits by single shooting explain the records, and intervals that allow for correlated noise.

    ``explained`` is the share of records that no test contradicts. ``reason`` states the contradictions of the first
    record. The intervals belong to the first record's parameters.
    """
    unit = np.ones(len(model.initial_states(start[:, :1])))
    fitting = Fitting(model, "single", 1, settings.measurement, unit)
    solution = run_fits(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
    residual, p = fitting.residuals(solution, data), len(model.names)
    jacobian = fitting.jacobians(solution, data)
    channels = len(model.measured)
    is_finite = np.isfinite(jacobian).all(axis=(0, 1)) & np.isfinite(residual).all(axis=0)
    # the effects of missing terms at one fit serve all records, which have the same truth
    fitted = np.exp(solution[:, int(np.argmax(is_finite))])
    terms = missing_terms(cell, model, fitted, settings.measurement) if is_finite.any() else {}
    verdicts = [
        adequacy.judge(residual[:, i], jacobian[:, :, i], channels, terms, seed=i)
        for i in np.flatnonzero(is_finite)[:TESTED]
    ]
    together = _together(residual[:, is_finite], jacobian[:, :, is_finite], channels, terms, len(residual) - p)
    wide_low, wide_high = [math.nan] * p, [math.nan] * p
    if is_finite[0]:
        independent = np.linalg.pinv(jacobian[:, :, 0].T @ jacobian[:, :, 0], rcond=1e-11, hermitian=True)
        correlated = adequacy.correlated_covariance(residual[:, 0], jacobian[:, :, 0], channels)
        half = performance.Z * np.sqrt(np.maximum(np.diag(independent), np.diag(correlated)))
        wide_low, wide_high = (np.exp(solution[:, 0] + side * half).tolist() for side in (-1.0, 1.0))
    share = float(np.mean([one.is_explained for one in verdicts])) if verdicts else math.nan
    first = verdicts[0].sentence() if is_finite[0] else "the fit of the first record is not finite"
    if first and is_finite[0]:
        intervals = ", ".join(
            f"{name} {low:.4g} to {high:.4g}" for name, low, high in zip(model.names, wide_low, wide_high, strict=True)
        )
        first += f"; under correlated noise they would be {intervals}"
    elif together and not together.is_explained:
        first = f"all records together: {together.sentence()}"
    return {
        "explained": share, "reason": first, "wide_low": wide_low, "wide_high": wide_high,
        "misfit": verdicts[0].probability if verdicts else math.nan,
        "misfit_together": together.probability if together else math.nan,
    }  # fmt: skip


def _together(
    residual: np.ndarray, jacobian: np.ndarray, channels: int, terms: dict[str, np.ndarray], free: int
) -> adequacy.Adequacy | None:
    """Return whether the model explains all records together, or None for fewer than two.

    A fit that ended elsewhere, with residuals far above the noise, is left out if at least half of the fits did not.
    """
    is_small = np.square(residual).sum(axis=0) <= chdtri(max(free, 1), UNEXPLAINED)
    chosen = is_small if is_small.mean() >= 0.5 else np.ones_like(is_small)
    if chosen.sum() < 2:
        return None
    return adequacy.judge(*adequacy.pool(residual[:, chosen], jacobian[:, :, chosen]), channels, terms)


def missing_terms(cell: Cell, model: Model, theta: np.ndarray, sigma: float) -> dict[str, np.ndarray]:
    """Return the change of the standardised record ``(m,)`` per unit of effects that the model lacks, by name.

    The effects are an offset, gain, drift and delay of each sensor, and accelerations of each coordinate: constant, and
    quadratic, cubic and signed in its velocity and position. They are computed at ``theta (p,)`` by central differences.
    """
    scene = model.program.scene
    channels, columns = len(model.measured), theta[:, None]
    plain = model.record(columns)[:, 0]
    terms = {}
    times = np.array(model.steps, dtype=float)
    table = plain.reshape(-1, channels)
    faults = {"an offset": np.ones_like(table), "a gain": table}
    if len(times) > 1:
        faults["a drift"] = np.repeat((2.0 * times / times[-1] - 1.0)[:, None], channels, axis=1)
        faults["a delay"] = -np.gradient(table, times, axis=0)
    for c, coordinate in enumerate(model.measured):
        for name, effect in faults.items():
            terms[f"{name} of sensor {coordinate}"] = (effect * np.eye(channels)[c]).ravel() / sigma
    states = model.simulate(columns, model.initial_states(columns), np.zeros(1, dtype=int), scene.horizon)[:, :, 0]
    size = max(float(np.abs(np.diff(states[:, scene.n_q :], axis=0)).max()) / scene.dt, 1e-12)
    for i in range(scene.n_q if len(states[0]) == 2 * scene.n_q else 0):
        x, v = (max(float(np.abs(states[:, j]).max()), 1e-12) for j in (i, scene.n_q + i))
        for name, effect in _effects(i, x, v).items():
            record = []
            for side in (1.0, -1.0):
                twin = _with_acceleration(scene, i, side * RELATIVE * size, effect)
                program = dataclasses.replace(model, program=_recomposed(cell, model, twin))
                record.append(program.record(columns)[:, 0])
            change = (record[0] - record[1]) / (2.0 * RELATIVE * sigma)
            if np.isfinite(change).all():
                terms[name] = change
    return terms


RELATIVE = 1e-4
"""Size of a missing acceleration whose effect is computed, relative to the largest acceleration of the motion."""


def _effects(i: int, x: float, v: float) -> dict[str, Any]:
    """Return accelerations of coordinate ``i`` as functions of q and v, scaled by their largest values x and v."""
    of = f"of coordinate {i}"
    return {
        f"a constant force {of}": lambda q, r: 1.0 + 0.0 * q[i],
        f"drag {of} in v|v|": lambda q, r: r[i] * np.abs(r[i]) / v**2,
        f"drag {of} in v^3": lambda q, r: (r[i] / v) ** 3,
        f"friction {of} in the sign of v": lambda q, r: np.tanh(100.0 * r[i] / v),
        f"a spring {of} in q^2": lambda q, r: (q[i] / x) ** 2,
        f"a spring {of} in q^3": lambda q, r: (q[i] / x) ** 3,
    }


def _with_acceleration(scene: MechanicalScene, i: int, size: float, effect: Any) -> MechanicalScene:
    """Return a copy of a scene with an additional acceleration of coordinate ``i``."""
    base = type(scene)

    def acceleration(self: Any, xp: Any, q: Any, v: Any, u: Any) -> Any:
        more = np.zeros((scene.n_q, 1))
        more[i] = size
        return base.acceleration(self, xp, q, v, u) + more * effect(q, v)

    twin = copy.copy(scene)
    object.__setattr__(twin, "__class__", type(base.__name__, (base,), {"acceleration": acceleration}))
    return twin


def _recomposed(cell: Cell, model: Model, scene: MechanicalScene) -> Rollout:
    program = compose(scene, cell.contact, cell.integrator, model.program.decision)
    assert isinstance(program, Rollout)
    return program


def _difference_of_fits(lines: dict[str, list[Any]], known: Information) -> str:
    """Return a remark if the first record's fits by single shooting and by independent windows differ, else "".

    The windows use less of the record, so that the variance of the difference is at least that of the windows' estimate
    minus that of single shooting (Hausman 1978).
    """
    count = known.rank
    single, windows = 0, SHOOTING.index("windows")
    if not count or len(lines["shooting"]) <= windows:
        return ""
    from scipy.special import ndtri

    logs = {k: np.log(np.array(lines["first"][k * count : (k + 1) * count], dtype=float)) for k in (single, windows)}
    halves = {
        k: (np.log(np.array(lines["estimate_high"][k * count : (k + 1) * count], dtype=float)) - logs[k])
        / performance.Z
        for k in (single, windows)
    }
    variance = halves[windows] ** 2 - halves[single] ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.abs(logs[windows] - logs[single]) / np.sqrt(variance)
    z = np.where(variance > 0.01 * halves[windows] ** 2, z, 0.0)
    worst = int(np.argmax(np.nan_to_num(z)))
    if np.nan_to_num(z[worst]) <= -ndtri(APART / (2.0 * count)):
        return ""
    values = [math.exp(logs[k][worst]) for k in (single, windows)]
    return (
        f"fits of the whole record and of its windows differ by {z[worst]:.1f} standard errors ({known.labels[worst]} "
        f"{values[0]:.4g} and {values[1]:.4g}): the model does not explain the record, or a fit ended elsewhere"
    )


LISTS = (
    "shooting", "converged", "converged_low", "converged_high", "error", "coverage", "coverage_low", "coverage_high",
    "hidden", "estimate", "estimate_low", "estimate_high", "first",
)  # fmt: skip


def _fit_statistics(
    model: Model, shooting: str, n_windows: int, optimizer: Optimizer, start: np.ndarray, data: np.ndarray,
    known: Information, settings: Settings,
) -> dict[str, Any]:  # fmt: skip
    """Return the entries of one shooting method in the columns :data:`LISTS`."""
    theta, begin = model.values[:, None], np.zeros(1, dtype=int)
    states = model.simulate(theta, model.initial_states(theta), begin, model.program.scene.horizon)
    unit = np.maximum(np.abs(states).max(axis=(0, 2)), 1e-6)
    fitting = Fitting(model, shooting, 1 if shooting == "single" else n_windows, settings.measurement, unit)
    solution = run_fits(fitting, optimizer, fitting.start(start, data), data, settings.iterations)
    residual = fitting.residuals(solution, data)
    p, measured = len(model.names), len(data)
    square = (residual[:measured] ** 2).sum(axis=0)
    # gaps of multiple shooting tie its initial states to the parameters
    free = max(measured - (fitting.dim if shooting == "windows" else p), 1)
    has_converged = np.isfinite(square) & (square <= chdtri(free, UNEXPLAINED))
    jacobian = fitting.jacobians(solution, data)
    logs, target = known.invariants @ solution[:p], known.invariants @ np.log(model.values)
    bound = np.sqrt(np.diag(known.covariance()))
    errors, inside, hidden, halves = [], [], 0, []
    for i in range(data.shape[1]):
        slopes = _parameters_only(jacobian[:, :, i], p)
        if not np.isfinite(slopes).all():
            halves.append(np.full(known.rank, np.nan))
            continue
        fit = Information(model.names, slopes)
        hidden += fit.rank > known.rank
        inverse = np.linalg.pinv(fit.fisher, rcond=1e-11, hermitian=True)
        halves.append(performance.Z * np.sqrt(np.diag(known.invariants @ inverse @ known.invariants.T)))
        if has_converged[i] and settings.data is None:
            errors.append((logs[:, i] - target) / bound)
            inside.append(np.abs(logs[:, i] - target) <= halves[-1])
    n_converged, n_fits = int(has_converged.sum()), data.shape[1]
    low, high = performance.wilson(n_converged, n_fits)
    is_covered = np.array(inside, dtype=float)
    coverage = float(is_covered.mean()) if is_covered.size else math.nan
    # the sample size of this interval is the number of records: invariants of one record are dependent
    interval = (
        performance.wilson(round(coverage * n_converged), n_converged) if is_covered.size else (math.nan, math.nan)
    )
    middle = np.median(logs[:, has_converged], axis=1) if n_converged else np.full(known.rank, np.nan)
    return {
        "shooting": shooting, "converged": n_converged / n_fits, "converged_low": low, "converged_high": high,
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors else math.nan,
        "coverage": coverage, "coverage_low": interval[0], "coverage_high": interval[1], "hidden": hidden,
        "estimate": np.exp(middle).tolist(), "estimate_low": np.exp(logs[:, 0] - halves[0]).tolist(),
        "estimate_high": np.exp(logs[:, 0] + halves[0]).tolist(), "first": np.exp(logs[:, 0]).tolist(),
    }  # fmt: skip


def _parameters_only(jacobian: np.ndarray, p: int) -> np.ndarray:
    """Return the Jacobian ``(m, p)`` with respect to the parameters, with the windows' initial states projected out."""
    if jacobian.shape[1] == p or not np.isfinite(jacobian).all():
        return jacobian[:, :p]
    basis, _ = np.linalg.qr(jacobian[:, p:])
    return np.asarray(jacobian[:, :p] - basis @ (basis.T @ jacobian[:, :p]))


def information(model: Model, theta: np.ndarray, sigma: float) -> Information:
    """Return the Fisher information of a record of ``theta (p,)`` on the logarithms of its parameters, by single shooting.

    ``sigma`` is the standard deviation of a measurement's noise.
    """
    p = len(theta)
    shifts = STEP * np.concatenate([np.eye(p), -np.eye(p)], axis=1)
    record = model.record(np.exp(np.log(theta)[:, None] + shifts))
    return Information(model.names, (record[:, :p] - record[:, p:]) / (2 * STEP * sigma))


def records(cell: Cell, model: Model, settings: Settings) -> np.ndarray:
    """Return the records ``(m, B)`` to fit: the user's single record, or ``repeats`` noisy records of the true motion."""
    assert isinstance(cell.scene, MechanicalScene)
    if settings.data is not None:
        return read(settings.data, cell.scene)[:, None]
    source = model if settings.refine == 1 else model_of(cell, refine(cell.scene, settings.refine), settings.refine)
    clean = source.record(source.values[:, None])
    drawn = noise.draw(cell.seed, cell.scene.name, cell.repeats, 1, len(clean), "identify: measurements")[:, 0].T
    return np.asarray(clean + settings.measurement * drawn)


def step_dependence(cell: Cell, model: Model, known: Information, settings: Settings) -> dict[str, Any]:
    """Return the columns ``step_shift`` and ``step_note``: how a noiseless fit changes when the model's step is halved.

    To first order, it is the least-squares change of the parameters that compensates the change of the record.
    """
    assert isinstance(cell.scene, MechanicalScene)
    half = model_of(cell, refine(cell.scene, 2), 2)
    theta = model.values[:, None]
    change = (half.record(theta) - model.record(theta))[:, 0] / settings.measurement
    if not known.rank or not np.isfinite(change).all():
        return {"step_shift": math.nan, "step_note": "not distinguishable"}
    shift = np.abs(known.invariants @ np.linalg.lstsq(known.jacobian, change, rcond=1e-8)[0])
    bound = np.sqrt(np.diag(known.covariance()))
    worst = int(np.argmax(shift / bound))
    validity = "this time step only" if shift[worst] > MAX_STEP_SHIFT * bound[worst] else "other steps too"
    note = (
        f"holds for {validity}: halving the step changes {known.labels[worst]} by {shift[worst]:.2g} of its value, "
        f"{shift[worst] / bound[worst]:.2g} times the bound of its error"
    )
    return {"step_shift": float(shift.max()), "step_note": note}
