"""The contract of an estimator, which computes estimates of grad J from sampled costs, gradients and scores."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from bench.errors import Unsupported
from bench.host.parameters import Plugin, param
from bench.model.design import (
    IID,
    LEAST_UNITS,
    MOST_COORDINATES,
    POINTS,
    UNITS,
    Design,
    block_of,
    per_unit,
    sums_of_units,
)
from bench.model.problem import Problem
from bench.model.program import Program

Auxiliaries = Mapping[str, np.ndarray]
"""Diagnostics of estimates, such as weights: arrays by name."""


@dataclass(frozen=True)
class Smoothing:
    """A smoothing other than J_sigma's: ``gaussian`` of standard deviation ``radius``, or uniform in a ``ball``."""

    shape: str
    radius: float


@dataclass(frozen=True)
class Estimator(Plugin):
    """Computes independent estimates of grad J from sampled costs and gradients."""

    kind: ClassVar[str] = "estimators"
    needs: ClassVar[frozenset[str]] = frozenset({"value"})
    """Required backend capabilities, a subset of ``value``, ``grad`` and ``score``."""
    target: ClassVar[str] = "smoothed"
    """The estimated quantity: ``smoothed`` for grad J_sigma, ``plain`` for grad f."""
    unbiased: ClassVar[bool] = True
    """Whether the expectation equals the target for continuous costs."""
    unbiased_at_discontinuities: ClassVar[bool] = False
    """Whether the estimator is also unbiased for costs with jumps in theta."""
    diagnostics: ClassVar[tuple[str, ...]] = ()
    """Names of the arrays that :meth:`estimate_with_diagnostics` returns in addition, for example ``weight``."""
    needs_noise_on_theta: ClassVar[bool] = False
    """Whether it excludes noise on the actions of a policy."""
    needs_directions: ClassVar[bool] = False
    """Whether it uses each sample's noise as a direction in theta space, which needs at least d numbers per sample."""
    smooths_theta: ClassVar[bool] = False
    """Whether it smooths over theta, also where the noise is on a policy's actions, and so has another target there."""
    couples_samples: ClassVar[bool] = False
    """Whether its directions are chosen together or a model is fitted to them, so that the variance may fall faster than 1/N."""
    least_samples: ClassVar[int] = 1
    """Fewest samples of an estimate."""
    in_units: ClassVar[bool] = False
    """Whether it computes a variance, a quantile or a baseline from the samples of an estimate, and does so over the units
    of :meth:`design`, whose samples are not independent of each other."""
    pairs_samples: ClassVar[bool] = False
    """Whether each term evaluates both w and -w, so that mirrored draws would repeat it."""
    needs_independent_samples: ClassVar[bool] = False
    """Whether it excludes other designs than independent draws, since it chooses directions or fits a model itself."""

    fixed_work: ClassVar[bool] = False
    """Whether an estimate takes the same work for all N, since it depends on no noise in J."""

    draws: str = param(
        "iid", "points of the noise of an estimate: independent, orthogonal, or a Sobol set", choices=POINTS, added=True
    )
    mirrored: bool = param(False, "whether each draw w of the noise is followed by -w", added=True)

    @abstractmethod
    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return R independent estimates ``(R, d)`` at ``theta (d,)`` from standard normal ``noise (R, N, n_w)``.

        All randomness comes from ``noise``: the only random input of estimate r is ``noise[r]``.
        """

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)`` and the :attr:`diagnostics` by name, each ``(R,)`` or ``(R, k)``.

        An estimator with diagnostics derives from :class:`DiagnosticEstimator` and defines this method.
        """
        return self.estimate(problem, theta, noise), {}

    def draws_noise(self, program: Program) -> bool:
        """Return whether estimates depend on the noise on theta or actions; if not, only on the scene's own noise."""
        return not self.fixed_work

    def declares_unbiased(self, program: Program) -> bool:
        """Return whether the estimator declares that its expectation is grad J_sigma of the program."""
        derivative = program.continuous and not program.surrogate
        is_target = self.target == "smoothed" and (program.noise_on_theta or not self.smooths_theta)
        return self.unbiased and is_target and (derivative or self.unbiased_at_discontinuities)

    def remark(self, diagnostics: Mapping[str, Mapping[str, float]]) -> str:
        """Return a doubt about intervals, from mean, quantiles and share of zeros of each diagnostic; empty if none."""
        return ""

    def smoothing(self, program: Program) -> Smoothing | None:
        """Return the smoothing whose gradient is the reference for this estimator's rows; None: J_sigma."""
        return None

    def own_refusal(self, program: Program) -> str | None:
        """Return why this estimator's own limits exclude the program, or None."""
        if self.needs_noise_on_theta and not program.noise_on_theta:
            return f"{self.name} needs noise on theta, not on a policy's actions"
        return None

    def design(self, program: Program, samples: int) -> Design:
        """Return how the noise of an estimate of N = ``samples`` is drawn; raises :class:`Unsupported` where it cannot be.

        Points cover the directions in theta space of an estimator that uses them, otherwise all noise but the scene's own.
        An estimator that compares samples gets at least 4 units, since it may treat only these as independent.
        """
        if samples < self.least_samples:
            raise Unsupported(f"{self.name} needs at least {self.least_samples} samples, got {samples}")
        if self.draws == "iid" and not self.mirrored:
            return IID
        if self.draws not in POINTS or not isinstance(self.mirrored, bool):
            raise Unsupported(
                f"{self.name} has draws={self.draws!r} and mirrored={self.mirrored!r}: parameters of its own need other names"
            )
        words = " and ".join(
            filter(None, [f"draws={self.draws}" * (self.draws != "iid"), "mirrored=true" * self.mirrored])
        )
        if not self.draws_noise(program):
            raise Unsupported(f"{self.name} depends on no noise in J, so {words} would change nothing")
        if self.needs_independent_samples:
            raise Unsupported(f"{self.name} chooses directions or fits a model from independent draws, without {words}")
        if self.mirrored and self.pairs_samples:
            raise Unsupported(
                f"{self.name} evaluates each direction both ways already, so mirrored draws would repeat its terms"
            )
        own = program.n_noise - program.exogenous
        width = program.dim if self.needs_directions else own
        if not own:
            raise Unsupported(f"{words} concerns the noise in J, and {program.scene.name} has only noise of its own")
        if self.draws == "sobol" and width > MOST_COORDINATES:
            raise Unsupported(f"a Sobol set has at most {MOST_COORDINATES:,} coordinates, and a sample has {width:,}")
        if samples % (1 + self.mirrored):
            raise Unsupported(f"mirrored draws are pairs, and samples={samples} is odd")
        count = samples // (1 + self.mirrored)
        block = block_of(self.draws, width, count, self.in_units)
        if self.draws == "sobol" and (block < 1 or block & (block - 1) or count % block):
            raise Unsupported(
                f"Sobol sets have a power of 2 of points: samples={samples} has no such sets, samples={1 << max(samples, 2 * UNITS - 1).bit_length()} has"
            )
        if block == 1 < width and self.draws != "iid":
            raise Unsupported(
                f"{self.name} compares at least {UNITS} units of {words}, and samples={samples} has no such units of several draws"
            )
        if self.in_units and count // block < LEAST_UNITS:
            raise Unsupported(
                f"{self.name} compares samples: it needs {LEAST_UNITS} independent units of {words}, and samples={samples} gives {count // block}"
            )
        return Design(self.draws, self.mirrored, width, program.exogenous, block)

    def refusal(self, program: Program, provides: frozenset[str], backend: str) -> str | None:
        """Return why the estimator cannot run on a program with the backend's capabilities ``provides``, or None."""
        missing = self.needs - provides
        if missing:
            return f"{self.name} needs {', '.join(sorted(missing))}, which {backend} lacks"
        if "grad" in self.needs and program.surrogate and "surrogate" not in provides:
            law = program.contact.name if program.contact else ""
            return f"{self.name} needs the surrogate gradient of contact law {law}, and {backend} computes differences of costs"
        if "score" in self.needs and program.score_refusal:
            return f"{self.name} needs scores, but {program.score_refusal}"
        own = program.n_noise - program.exogenous
        if self.needs_directions and own < program.dim:
            return f"{self.name} needs {program.dim} normal numbers per sample, and the noise model has {own}"
        return self.own_refusal(program)


@dataclass(frozen=True)
class DiagnosticEstimator(Estimator):
    """An estimator with diagnostics. It defines :meth:`estimate_with_diagnostics` instead of :meth:`estimate`."""

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the estimates ``(R, d)`` without diagnostics."""
        return self.estimate_with_diagnostics(problem, theta, noise)[0]

    @abstractmethod
    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)`` and the :attr:`diagnostics` by name, each ``(R,)`` or ``(R, k)``."""


@dataclass(frozen=True)
class SampleMean(Estimator):
    """An estimator that is the mean of one term per sample, so that samples can be evaluated in batches."""

    @property
    def separable(self) -> bool:
        """Whether each estimate is the mean of its terms: true unless a subclass overrides :meth:`estimate`."""
        return type(self).estimate is SampleMean.estimate

    @abstractmethod
    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return per-sample terms ``(d, B)`` for noise ``w (n_w, B)``."""

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of the terms over the samples of each repeat, ``(R, d)``."""
        w = columns(noise)
        terms = np.asarray(np.ma.filled(self.terms(problem, theta, w), np.nan))
        require_shape(self, "(d, B)", terms, (problem.dim, w.shape[1]))
        return per_repeat(terms, noise).mean(axis=1)


def require_shape(estimator: Estimator, meaning: str, result: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raise ValueError, with the estimator's file, unless a result has the shape whose ``meaning`` is ``(d, B)``."""
    if result.shape != shape:
        file = getattr(sys.modules.get(type(estimator).__module__), "__file__", None)
        where = f" in {Path(file).name}" if file else ""  # a notebook's class has no file
        raise ValueError(f"{estimator.name}{where} returned shape {result.shape}, not {meaning} = {shape}")


def columns(noise: np.ndarray) -> np.ndarray:
    """Reshape noise ``(R, N, n_w)`` to a batch ``(n_w, R * N)`` for a problem."""
    return np.moveaxis(noise, -1, 0).reshape(noise.shape[-1], -1)


def per_repeat(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Reshape batch results ``(d, R * N)`` to ``(R, N, d)``, or ``(R * N,)`` to ``(R, N)``."""
    repeats, samples = noise.shape[:2]
    if values.ndim == 1:
        return values.reshape(repeats, samples)
    return np.moveaxis(values.reshape(-1, repeats, samples), 0, -1)


def halves(
    problem: Problem, theta: np.ndarray, noise: np.ndarray, unit: int = 1, leave_out: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return first-order terms of the first half of the samples and zeroth-order terms of the rest, each ``(R, K, d)``.

    A term is the mean over a ``unit`` of samples that are drawn together, and no unit is in both halves. The zeroth-order
    terms are (f - b) times the score, b being f at w = 0, or with ``leave_out`` the mean cost of the other units. There
    are at least 4 units.
    """
    half = noise.shape[1] // unit // 2 * unit
    rest = noise[:, half:]
    zeroth = against_others(problem, theta, rest, unit) if leave_out else zeroth_order(problem, theta, rest)
    return per_unit(first_order(problem, theta, noise[:, :half]), unit), per_unit(zeroth, unit)


def first_order(problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the gradient of each sample, ``(R, N, d)``."""
    return per_repeat(problem.grad(theta, columns(noise)), noise)


def zeroth_order(problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return (f - f at w = 0) times the score of each sample, ``(R, N, d)``."""
    w = columns(noise)
    cost = problem.value(theta, w) - problem.value(theta, np.zeros((w.shape[0], 1)))
    return per_repeat(cost * problem.score(theta, w), noise)


def against_others(problem: Problem, theta: np.ndarray, noise: np.ndarray, unit: int = 1) -> np.ndarray:
    """Return (f - mean f of the other units) times the score of each sample, ``(R, N, d)``."""
    w = columns(noise)
    cost = less_others(per_repeat(problem.value(theta, w), noise), unit)
    return cost[..., None] * per_repeat(problem.score(theta, w), noise)


def less_others(costs: np.ndarray, unit: int = 1) -> np.ndarray:
    """Return costs ``(R, N)`` less the mean cost of the samples in other units than their own."""
    n = costs.shape[1]
    centred = costs - costs.mean(axis=1, keepdims=True)
    return np.asarray(centred * n / (n - unit) + (sums_of_units(centred, unit) - unit * centred) / (n - unit))


def mean_difference(problem: Problem, theta: np.ndarray, directions: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the mean of (f(theta + sigma v) - f(theta - sigma v)) v / 2 sigma over directions ``(R, N, d)``, ``(R, d)``."""
    s, centred = problem.sigma, problem.centred(columns(noise))
    shift = s * columns(directions)
    change = problem.displaced(shift, theta, centred) - problem.displaced(-shift, theta, centred)
    return per_repeat(change * shift / (2.0 * s * s), noise).mean(axis=1)


def best_gradient(problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the best gradient available, ``(R, d)``: without noise, or the mean of costs times scores where the cost jumps."""
    if not problem.program.continuous:
        return zeroth_order(problem, theta, noise).mean(axis=1)
    gradient = problem.grad(theta, problem.program.noise_free).mean(axis=1, keepdims=True)
    return np.repeat(gradient.T, len(noise), axis=0)
