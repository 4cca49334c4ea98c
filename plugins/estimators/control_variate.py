"""Zeroth order with the linear part of the cost as a control variate."""

from dataclasses import dataclass

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, columns, per_repeat, per_unit, zeroth_order


@dataclass(frozen=True)
class ControlVariate(DiagnosticEstimator):
    """Approximates grad J_sigma with the zeroth order minus c (g . w) w plus c g, g being df/dtheta at w = 0.

    (g . w) w has the known expectation g, so the result is unbiased for any cost and any c, even if g is wrong. c is
    the regression coefficient from the other half of the samples, which is independent and adds no bias. It removes the
    variance of the cost's linear part, as a Taylor control variate does (Glasserman 2003, ch. 4; Mohamed et al. 2020,
    section 7), and tends to 0 where g is unrelated to the cost. Requires costs, gradients and scores, with noise on
    theta, and at least 4 samples. Reports c as ``coefficient``, the mean of both halves.
    """

    name = "control_variate"
    needs_noise_on_theta = True
    needs = frozenset({"value", "grad", "score"})
    unbiased_at_discontinuities = True
    in_units = True
    least_samples = 4
    diagnostics = ("coefficient",)

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)``, and ``coefficient``, ``(R,)``."""
        centre = problem.grad(theta, np.zeros((noise.shape[2], 1)))[:, 0]
        zeroth = zeroth_order(problem, theta, noise)
        w = columns(noise)[: problem.dim]
        control = per_repeat((centre @ w) * w, noise)
        unit = self.design(problem.program, noise.shape[1]).unit
        half = noise.shape[1] // unit // 2 * unit
        parts = (slice(0, half), slice(half, None))
        # each half is corrected with the coefficient of the other
        coefficients = [_slope(*(per_unit(of[:, part], unit) for of in (control, zeroth))) for part in reversed(parts)]
        corrected = [
            zeroth[:, part] - c[:, None, None] * (control[:, part] - centre)
            for part, c in zip(parts, coefficients, strict=True)
        ]
        return np.concatenate(corrected, axis=1).mean(axis=1), {"coefficient": np.mean(coefficients, axis=0)}


def _slope(control: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the regression coefficient of values on the control over samples, ``(R,)``; 0 for a constant control."""
    control = control - control.mean(axis=1, keepdims=True)
    covariance, variance = (np.einsum("rnd,rnd->r", control, other) for other in (values, control))
    return np.divide(covariance, variance, out=np.zeros_like(variance), where=variance > 0)
