"""Finds the parameters that a record identifies: Fisher information, unidentifiable directions, the Cramer-Rao bound.

All quantities refer to logarithms of the parameters, so a direction is a product of powers. A null vector (1, 1, 1) of
mass, stiffness and damping means that scaling all three together does not change the data: only their ratios are
identifiable.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

RANK_TOLERANCE = 1e-6
"""Singular values below this share of the largest count as 0: Jacobians from differences are accurate to about 1e-9."""


@dataclass(frozen=True, eq=False)
class Information:
    """The Fisher information in the Jacobian ``(m, p)`` of standardised residuals by logarithms of named parameters."""

    names: tuple[str, ...]
    jacobian: np.ndarray

    @cached_property
    def _svd(self) -> tuple[np.ndarray, np.ndarray]:
        _, values, rows = np.linalg.svd(self.jacobian, full_matrices=True)
        return np.append(values, np.zeros(len(rows) - len(values))), rows

    @property
    def fisher(self) -> np.ndarray:
        """The Fisher information of the logarithms, ``(p, p)``."""
        return np.asarray(self.jacobian.T @ self.jacobian)

    @property
    def rank(self) -> int:
        """Number of identifiable directions."""
        values, _ = self._svd
        return int((values > RANK_TOLERANCE * values[0]).sum()) if values[0] > 0 else 0

    @property
    def condition(self) -> float:
        """The largest singular value over the smallest that counts as nonzero; inf if none does."""
        values, _ = self._svd
        return float(values[0] / values[self.rank - 1]) if self.rank else np.inf

    @property
    def gauge(self) -> np.ndarray:
        """The unidentifiable directions as rows, ``(p - rank, p)``."""
        return self._svd[1][self.rank :]

    @cached_property
    def invariants(self) -> np.ndarray:
        """Exponents of the identifiable products of powers, ``(rank, p)``; unit vectors if all are identifiable.

        Each unidentifiable direction has one leading parameter. Every other parameter is divided by the powers of the
        leading parameters that scale with it.
        """
        rows = self.gauge.copy()
        leaders: list[int] = []
        for i in range(len(rows)):
            free = [j for j in range(rows.shape[1]) if j not in leaders]
            size = np.abs(rows[i][free])
            # the first of nearly equal entries, so that the text does not depend on rounding
            lead = free[int(np.flatnonzero(size > 0.9 * size.max())[0])]
            rows[i] /= rows[i, lead]
            for k in range(len(rows)):
                if k != i:
                    rows[k] -= rows[k, lead] * rows[i]
            leaders.append(lead)
        result = []
        for j in range(len(self.names)):
            if j not in leaders:
                exponents = np.zeros(len(self.names))
                exponents[j] = 1.0
                for lead, row in zip(leaders, rows, strict=True):
                    exponents[lead] -= row[j]
                result.append(exponents)
        return np.array(result).reshape(-1, len(self.names))

    @property
    def labels(self) -> list[str]:
        """The invariants as products: ``stiffness/mass``."""
        return [product(self.names, row) for row in self.invariants]

    def along(self, jacobian: np.ndarray) -> np.ndarray:
        """Return a Jacobian ``(m, p)`` by logarithms of the parameters as one by logarithms of the invariants, ``(m, rank)``."""
        return np.asarray(jacobian @ np.linalg.pinv(self.invariants))

    @property
    def bound(self) -> np.ndarray:
        """The Cramer-Rao bound on the standard deviations of the invariants' logarithms, ``(rank,)``."""
        slopes = self.along(self.jacobian)
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))))


def product(names: tuple[str, ...], exponents: np.ndarray) -> str:
    """Return a product of powers as text: ``stiffness/mass``, ``damping^2*mass``."""
    above: list[str] = []
    below: list[str] = []
    for name, exponent in zip(names, exponents, strict=True):
        if abs(exponent) > 1e-4:
            power = _power(abs(exponent))
            (above if exponent > 0 else below).append(name + power)
    return ("*".join(above) or "1") + "".join(f"/{name}" for name in below)


def _power(exponent: float) -> str:
    near = Fraction(exponent).limit_denominator(12)
    if abs(float(near) - exponent) > 1e-3:
        return f"^{exponent:.3g}"
    return "" if near == 1 else f"^{near}" if near.denominator == 1 else f"^({near})"
