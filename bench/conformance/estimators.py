"""Checks of estimators on costs whose smoothed gradient is known."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable
from functools import cache, lru_cache, partialmethod
from typing import Any, NamedTuple

import numpy as np

from bench.conformance.kit import Failed, Skipped, require, skip_unless, verifies
from bench.conformance.scenes import closed_form_is_right
from bench.conformance.subjects import (
    DIFFERENCED,
    Z_LIMIT,
    distance,
    plain_backend,
    rng,
    sound_scenes,
    standard_errors,
    stepping,
)
from bench.host.identity import identity
from bench.host.parameters import parameters
from bench.measure import noise
from bench.model import (
    Design,
    Estimator,
    FunctionScene,
    MechanicalScene,
    Problem,
    Program,
    SampleMean,
    Unsupported,
    compose,
)
from bench.model.estimator import require_shape

SIGMAS = (0.1, 0.5)
"""Noise levels of the oracles. 1 is excluded, because sigma and its square would be equal."""
DESIGNS: tuple[tuple[int, dict[str, Any]], ...] = (
    (8, {"mirrored": True}),
    (16, {"draws": "orthogonal"}),
    (16, {"draws": "sobol"}),
)
"""Numbers of samples and designs of the noise that are checked."""
DESIGNED = 4
"""Number of oracles of such a check."""


class RecordingProblem(Problem):
    """A problem that records which capabilities are used, and rejects undeclared capabilities."""

    def __init__(self, inner: Problem, allowed: frozenset[str]) -> None:
        super().__init__(inner.program)
        self._inner, self._allowed = inner, allowed
        self.used: set[str] = set()

    def _use(self, capability: str, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        require(capability in self._allowed, f"uses {capability}, which is not in needs")
        self.used.add(capability)
        return np.asarray(getattr(self._inner, capability)(theta, w))

    value = partialmethod(_use, "value")
    grad = partialmethod(_use, "grad")
    score = partialmethod(_use, "score")
    _value = _grad = _score = None  # type: ignore[assignment]


class AwayFromJumps(Problem):
    """A problem with jumps, without the few gradients that are differences of costs on both sides of a jump.

    Such a difference is the jump's height over the step, about 1e6, and hides any bias.
    """

    def __init__(self, inner: Problem) -> None:
        super().__init__(inner.program)
        self._value, self._score, self._differences = inner._value, inner._score, inner._grad  # type: ignore[method-assign]

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        # distance at which a gradient is compared: ten steps of the plain backend's differences
        here, beside = self._differences(theta, w), self._differences(theta + 1e-5, w)
        return np.where(np.abs(here) > 2 * np.abs(beside) + 1, beside, here)


class Oracle(NamedTuple):
    """A problem with a known gradient: ``truth (d,)`` with standard errors ``error (d,)``."""

    problem: Problem
    truth: np.ndarray
    error: np.ndarray
    label: str

    @property
    def program(self) -> Program:
        """The problem's program."""
        return self.problem.program

    @property
    def plain(self) -> np.ndarray:
        """The gradient of the cost without noise, ``(d,)``."""
        return self.problem.grad()


@cache
def oracles() -> tuple[Oracle, ...]:
    """Return an oracle for every sound function with a valid closed-form gradient, at each of :data:`SIGMAS`."""
    result = []
    for default, sigma in itertools.product(sound_scenes(), SIGMAS):
        if isinstance(default, FunctionScene):
            is_wide = sigma == SIGMAS[-1] and "dimension" in parameters(type(default))
            # the oracles at the last sigma whose scene has a parameter dimension
            changes: dict[str, Any] = {"dimension": 20} if is_wide else {}
            changes["sigma"] = sigma
            scene = dataclasses.replace(default, **changes)
            try:
                closed_form_is_right(scene)
            except Exception:
                continue
            program = compose(scene)
            truth = np.asarray(program.closed_form_gradient())
            problem = plain_backend().compile(program)
            if not program.continuous:
                problem = AwayFromJumps(problem)
            result.append(Oracle(problem, truth, np.zeros_like(truth), identity(scene.name, changes)))
    return tuple(result)


@cache
def feedback_oracle() -> Oracle:
    """Return a smooth five-step oracle with noise on a policy's actions, and its gradient from first-order sampling."""
    for default in sound_scenes():
        if not isinstance(default, MechanicalScene) or default.n_contacts or not default.continuous:
            continue
        program = compose(dataclasses.replace(default, horizon=5, sigma=2.0), None, stepping())
        if not program.noise_on_theta:
            problem = plain_backend().compile(program)
            w = rng("feedback").standard_normal((program.n_noise, 1 << 15))
            terms = problem.grad(program.theta0, w)
            error = terms.std(axis=1) / math.sqrt(w.shape[1])
            return Oracle(problem, terms.mean(axis=1), error, f"{program.scene.name}[horizon=5,sigma=2]")
    raise Skipped("no scene with a policy under action noise is registered")


def varying_oracle(estimator: Estimator) -> Oracle:
    """Return the first oracle whose samples all have different gradients and whose gradient depends on sigma.

    It is continuous if the estimator supports such a one.
    """
    for oracle in usable(estimator, sorted(oracles(), key=lambda oracle: not oracle.program.continuous)):
        w = rng("lively").standard_normal((oracle.program.n_noise, 64))
        gradients = oracle.problem.grad(oracle.program.theta0, w)
        if len(np.unique(gradients[0])) == 64 and distance(oracle.truth, oracle.plain) > 1e-3:
            return oracle
    raise Skipped("supports no oracle whose samples all differ")


def sampled_oracle(estimator: Estimator) -> Oracle:
    """Return :func:`varying_oracle`; skips an estimator that declares that it draws no noise there."""
    oracle = varying_oracle(estimator)
    skip_unless(estimator.draws_noise(oracle.program), "declares that it draws no noise")
    return oracle


def usable(estimator: Estimator, candidates: Iterable[Oracle]) -> list[Oracle]:
    """Return the oracles that the estimator supports; raises :class:`Skipped` if there are none."""
    able = [oracle for oracle in candidates if estimator.own_refusal(oracle.program) is None]
    skip_unless(able, "supports no such oracle")
    return able


def draw_noise(oracle: Oracle, repeats: int, count: int, *key: str | int) -> np.ndarray:
    """Return read-only noise ``(R, N, n_w)``, in the form that estimators get."""
    noise = rng("noise", *key).standard_normal((repeats, count, oracle.program.n_noise))
    noise.setflags(write=False)
    return noise


def estimates(estimator: Estimator, oracle: Oracle, noise: np.ndarray, problem: Problem | None = None) -> np.ndarray:
    """Return estimates ``(R, d)``; raises :class:`Failed` if the shape is wrong or a number is not finite."""
    problem = problem or oracle.problem
    result = np.asarray(estimator.estimate(problem, problem.program.theta0, noise))
    require_shape(estimator, "(R, d)", result, (noise.shape[0], problem.dim))
    require(np.isfinite(result).all(), f"{(~np.isfinite(result)).sum()} numbers are not finite on {oracle.label}")
    return result


def target(estimator: Estimator, oracle: Oracle) -> np.ndarray:
    """Return the gradient that the estimator declares as its target, ``(d,)``."""
    return oracle.truth if estimator.target == "smoothed" else oracle.plain


@verifies(Estimator)
def shape_and_repeatability(estimator: Estimator) -> str:
    """Verify that estimates are ``(R, d)``, finite, and the same in a second call."""
    able = usable(estimator, oracles())
    for oracle in able:
        noise = draw_noise(oracle, 7, 8)
        first, second = estimates(estimator, oracle, noise), estimates(estimator, oracle, noise)
        require(np.array_equal(first, second), f"a second call with the same noise differs on {oracle.label}")
    return f"{len(able)} oracles"


@verifies(Estimator)
def diagnostics_are_as_declared(estimator: Estimator) -> str:
    """Verify that ``estimate_with_diagnostics`` returns the same estimates, and finite, declared diagnostics."""
    oracle = varying_oracle(estimator)
    noise = draw_noise(oracle, 6, 8)
    values, diagnostics = estimator.estimate_with_diagnostics(oracle.problem, oracle.program.theta0, noise)
    same = np.array_equal(values, estimates(estimator, oracle, noise))
    require(same, "estimate_with_diagnostics and estimate return different estimates")
    require(
        tuple(diagnostics) == estimator.diagnostics,
        f"returns diagnostics {', '.join(diagnostics)}, declares {', '.join(estimator.diagnostics)}",
    )
    for name, array in diagnostics.items():
        shapes = [(6,), (6, oracle.problem.dim)]
        require(np.shape(array) in shapes, f"{name} has shape {np.shape(array)}, not one of {shapes}")
        require(np.isfinite(array).all(), f"{name} is not finite")
    return ", ".join(diagnostics) or "no diagnostics"


@verifies(Estimator)
def noise_is_drawn_as_declared(estimator: Estimator) -> str:
    """Verify that noise on theta changes no estimate without ``draws_noise``, and with it those of the varying oracle."""
    still = [oracle for oracle in usable(estimator, oracles()) if not estimator.draws_noise(oracle.program)]
    for oracle in still:
        require(not _noise_moves(estimator, oracle), f"depends on the noise on {oracle.label}, against draws_noise")
    if still:
        return f"no noise on {len(still)} oracles"
    moves = _noise_moves(estimator, varying_oracle(estimator))
    require(moves, "does not depend on the noise: draws_noise(program) has to return False")
    return "noise"


def _noise_moves(estimator: Estimator, oracle: Oracle) -> bool:
    """Return whether other noise on theta, with the same noise of the scene's own, changes estimates beyond rounding."""
    first, other = (np.array(draw_noise(oracle, 2, 8, key)) for key in ("drawn", "redrawn"))
    own = oracle.program.n_noise - oracle.program.exogenous
    other[..., own:] = first[..., own:]
    return distance(*(estimates(estimator, oracle, noise) for noise in (other, first))) > DIFFERENCED


@verifies(Estimator)
def repeats_are_independent(estimator: Estimator) -> str:
    """Verify that estimate r depends only on ``noise[r]``."""
    oracle = sampled_oracle(estimator)
    noise = np.array(draw_noise(oracle, 6, 8))
    whole = estimates(estimator, oracle, noise)
    order = np.array([3, 0, 5, 1, 4, 2])
    worst = distance(estimates(estimator, oracle, noise[order]), whole[order])
    require(worst < DIFFERENCED, f"permuting the repeats changes the estimates by {worst:.1e}")
    for r in range(len(noise)):
        alone = distance(estimates(estimator, oracle, noise[r : r + 1]), whole[r : r + 1])
        require(alone < DIFFERENCED, f"estimate {r} computed separately differs from the batch by {alone:.1e}")
        changed = noise.copy()
        changed[r] = draw_noise(oracle, 1, 8, "other")[0]
        moved = np.abs(estimates(estimator, oracle, changed) - whole).max(axis=1) > DIFFERENCED * np.abs(whole).max()
        require(moved[r], f"estimate {r} does not depend on its own noise")
        require(moved.sum() == 1, f"the noise of repeat {r} changes estimates {np.flatnonzero(moved).tolist()}")
        worst = max(worst, alone)
    return f"differences up to {worst:.0e}"


@verifies(Estimator)
def uses_every_sample(estimator: Estimator) -> str:
    """Verify that the estimate depends on the noise of each of 8 samples, or else of each eighth of 4096 samples."""
    oracle = sampled_oracle(estimator)
    unused = set(range(8))
    for size in (1, 512):
        noise = draw_noise(oracle, 8, 8 * size)
        whole = estimates(estimator, oracle, noise)
        for n in sorted(unused):
            changed = noise.copy()
            changed[:, n * size : (n + 1) * size] = draw_noise(oracle, 8, size, "other")
            if distance(estimates(estimator, oracle, changed), whole) > DIFFERENCED:
                unused.remove(n)
        if not unused:
            return f"all of {8 * size}"
    raise Failed(f"eighths {sorted(unused)} of the samples are not used")


@verifies(Estimator)
def variance_falls_as_one_over_n(estimator: Estimator) -> str:
    """Verify the slope of log variance against log N: -1 for sample means and unbiased estimators, else at most -1.

    An unbiased estimator that is not a sample mean may declare ``couples_samples = True``, since its directions are
    chosen together or a model is fitted to them. Its variance may fall faster than 1/N.
    """
    oracle = sampled_oracle(estimator)
    counts, groups = np.array([32, 128, 512]), 16
    logs = np.empty((len(counts), groups))
    for i, n in enumerate(counts):
        values = estimates(estimator, oracle, draw_noise(oracle, 32 * groups, n, "slope", i))
        variance = values.reshape(groups, 32, -1).var(axis=1, ddof=1).sum(axis=1)
        require((variance > 0).all(), f"estimates of {n} samples have no variance, where the samples differ")
        logs[i] = np.log(variance)
    slopes = np.polyfit(np.log(counts), logs, 1)[0]
    slope, error = slopes.mean(), slopes.std(ddof=1) / math.sqrt(groups)
    allowed = Z_LIMIT * error + 0.02  # 0.02 allows terms of order 1/N^2 (leave-one-out baselines) at N = 32
    detail = f"slope {slope:.3f} +- {error:.3f}"
    require(slope < -1 + allowed, f"{detail}: falls slower than 1/N")
    is_coupled = estimator.couples_samples and not isinstance(estimator, SampleMean)
    if (isinstance(estimator, SampleMean) or estimator.unbiased) and not is_coupled:
        require(slope > -1 - allowed, f"{detail}: falls faster than 1/N, without couples_samples = True")
    return detail


@verifies(Estimator)
def bias_is_as_declared(estimator: Estimator) -> str:
    """Verify the bias on continuous costs: none if ``unbiased``, else smaller than the bias of the zero estimate.

    Where an estimator draws no noise, only costs whose smoothed gradient is that of the cost without noise count.
    """
    candidates = usable(estimator, [o for o in oracles() if o.program.continuous])
    able = [o for o in candidates if estimator.draws_noise(o.program) or distance(o.plain, o.truth) < DIFFERENCED]
    skip_unless(able, "draws no noise where smoothing changes the gradient")
    return _verify_bias(estimator, able)


@verifies(Estimator)
def bias_across_jumps_is_as_declared(estimator: Estimator) -> str:
    """Verify the bias on discontinuous costs: none if ``unbiased_at_discontinuities``, else a significant bias."""
    skip_unless(estimator.unbiased and estimator.target == "smoothed", "declares a bias everywhere, or another target")
    candidates = usable(estimator, [o for o in oracles() if not o.program.continuous])
    if estimator.unbiased_at_discontinuities:
        return _verify_bias(estimator, candidates)
    details = []
    for oracle in candidates:
        z, bias = _standard_errors(estimator, oracle, 4, 4096)
        detail = f"bias {np.linalg.norm(bias):.3g} on {oracle.label}"
        require(z.max() > Z_LIMIT, f"declares to be biased across jumps, but {detail} is {z.max():.1f} standard errors")
        details.append(detail)
    return ", ".join(details)


@verifies(Estimator)
def bias_under_action_feedback(estimator: Estimator) -> str:
    """Verify the bias with noise on the actions of a feedback policy, for estimators that use the policy's score."""
    skip_unless("score" in estimator.needs and estimator.target == "smoothed", "does not use the score")
    return _verify_bias(estimator, usable(estimator, [feedback_oracle()]))


@verifies(Estimator)
def bias_under_every_design(estimator: Estimator) -> str:
    """Verify that an unbiased estimator is unbiased for each design of its noise; a design that it refuses is skipped.

    Each single draw of a design is standard normal. An estimator that treats the samples of a unit as independent, for
    example in a baseline, is biased.
    """
    skip_unless(estimator.unbiased and estimator.target == "smoothed", "declares a bias, or another target")
    candidates = usable(estimator, [o for o in oracles() if o.program.continuous])
    # in few dimensions, bias stands out
    candidates = sorted(candidates, key=lambda oracle: oracle.problem.dim)[:DESIGNED]
    details = []
    for count, given in DESIGNS:
        method = dataclasses.replace(estimator, **given)
        worst = 0.0
        for oracle in candidates:
            try:
                design = method.design(oracle.program, count)
            except Unsupported as refusal:
                details.append(str(refusal))
                break
            z, bias = _beyond_errors(method, oracle, _designed_noise(count, oracle.program.n_noise, design))
            size = np.linalg.norm(bias)
            require(
                float(z.max()) <= Z_LIMIT,
                f"is biased with {identity(method.name, given)}: by {size:.3g}, {z.max():.1f} standard errors, on {oracle.label}: "
                "a variance, quantile or baseline must use whole units of design(), or needs_independent_samples = True",
            )
            worst = max(worst, float(z.max()))
        else:
            details.append(f"at most {worst:.2g} standard errors with {identity('', given)}")
    return "; ".join(details)


@lru_cache(maxsize=32)
def _designed_noise(count: int, width: int, design: Design) -> np.ndarray:
    """Return read-only noise of a design, ``(256, count, width)``."""
    drawn = np.stack([noise.samples_of(rng("design", i), count, width, design) for i in range(256)])
    drawn.setflags(write=False)
    return drawn


def _verify_bias(estimator: Estimator, candidates: list[Oracle]) -> str:
    """Verify that the bias is 0 if the estimator is unbiased, else smaller than the bias of the zero estimate."""
    count, repeats = (4, 8192) if estimator.unbiased else (256, 128)
    worst = 0.0
    for oracle in candidates:
        z, bias = _standard_errors(estimator, oracle, count, repeats)
        size, norm, errors = np.linalg.norm(bias), np.linalg.norm(target(estimator, oracle)), float(z.max())
        require(
            errors <= Z_LIMIT or (size < norm and not estimator.unbiased),
            f"declares to be {'unbiased' * estimator.unbiased or 'biased'}, but the bias at {count} samples on {oracle.label} is "
            f"{size:.3g}, {errors:.1f} standard errors, of a gradient of {norm:.3g}: look for a wrong sign or scale; if it is "
            "meant, name this check in expected_failures",
        )
        worst = max(worst, errors if estimator.unbiased else float(size / (norm or math.inf)))
    dimensions = max(oracle.problem.dim for oracle in candidates)
    unit = "standard errors" if estimator.unbiased else f"of the gradient at {count} samples"
    return f"at most {worst:.2g} {unit} on {len(candidates)} oracles of up to {dimensions} dimensions"


def _standard_errors(estimator: Estimator, oracle: Oracle, count: int, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bias beyond rounding in standard errors, and the bias itself, both ``(d,)``."""
    return _beyond_errors(estimator, oracle, draw_noise(oracle, repeats, count, oracle.label, count))


def _beyond_errors(estimator: Estimator, oracle: Oracle, drawn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bias of estimates from ``drawn (R, N, n_w)`` as :func:`_standard_errors` does."""
    values, truth = estimates(estimator, oracle, drawn), target(estimator, oracle)
    bias = values.mean(axis=0) - truth
    error = np.sqrt(values.var(axis=0, ddof=1) / len(drawn) + oracle.error**2)
    return standard_errors(bias, error, DIFFERENCED * (1 + np.abs(truth))), bias


@verifies(Estimator)
def needs_are_truthful(estimator: Estimator) -> str:
    """Verify that the estimator uses every capability in ``needs``, and no other capability."""
    used: set[str] = set()
    for oracle in usable(estimator, oracles()):  # some capabilities may be for costs with events only
        recording = RecordingProblem(oracle.problem, estimator.needs)
        estimates(estimator, oracle, draw_noise(oracle, 4, 8), recording)
        used |= recording.used
    unused = sorted(estimator.needs - used)
    require(not unused, f"never uses {', '.join(unused)}, which it declares in needs")
    return ", ".join(sorted(used))
