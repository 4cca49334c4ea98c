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
    def rank(self) -> int:
        """Number of identifiable directions."""
        return int(np.linalg.matrix_rank(self.jacobian, rtol=RANK_TOLERANCE))

    @property
    def condition(self) -> float:
        """The largest singular value over the smallest that counts as nonzero; inf if none does."""
        values = np.linalg.svd(self.jacobian, compute_uv=False)
        return float(values[0] / values[self.rank - 1]) if self.rank else np.inf

    @cached_property
    def invariants(self) -> np.ndarray:
        """Exponents of the identifiable products of powers, ``(rank, p)``; unit vectors if all are identifiable.

        A parameter depends on those after it if it moves the data as they do together. Every other parameter is multiplied
        by the powers of the dependent ones that scale with it.
        """
        least = RANK_TOLERANCE * np.linalg.norm(self.jacobian, 2)
        ranks = [np.linalg.matrix_rank(self.jacobian[:, i:], least) for i in range(len(self.names) + 1)]
        is_dependent = np.diff(ranks) == 0
        result = np.eye(len(self.names))[~is_dependent]
        result[:, is_dependent] = np.linalg.pinv(self.jacobian[:, ~is_dependent]) @ self.jacobian[:, is_dependent]
        return result

    @property
    def labels(self) -> list[str]:
        """The invariants as products: ``stiffness/mass``."""
        return [product(self.names, row) for row in self.invariants]

    def along(self, jacobian: np.ndarray) -> np.ndarray:
        """Return a Jacobian ``(m, p)`` by logarithms of the parameters as one by logarithms of the invariants, ``(m, rank)``."""
        return jacobian @ np.linalg.pinv(self.invariants)

    @property
    def bound(self) -> np.ndarray:
        """The Cramer-Rao bound on the standard deviations of the invariants' logarithms, ``(rank,)``."""
        slopes = self.along(self.jacobian)
        return np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))


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
