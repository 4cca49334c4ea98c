"""Fits of all records at once, by single shooting, multiple shooting or independent windows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.model import Answer, Optimizer

from .. import norm
from .information import Information
from .model import STEP, Model

CONVERGED = 1e-3
"""Remaining step of a converged fit, in standard errors by its residuals, and its square by the noise."""


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


def information(model: Model, theta: np.ndarray, sigma: float) -> Information:
    """Return the Fisher information of a record of ``theta (p,)`` on the logarithms of its parameters, by single shooting.

    ``sigma`` is the standard deviation of a measurement's noise.
    """
    points = model.points(theta[:, None])
    fitting = Fitting(model, "single", 1, sigma)
    return Information(model.names, fitting.jacobians(points, model.record(theta[:, None]))[:, :, 0])
