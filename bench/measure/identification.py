"""What a record can say about parameters: Fisher information, gauge directions in words, the Cramer-Rao bound.

Everything is in logarithms of the parameters, so that a direction is a product of powers: a null vector (1, 1, 1) of mass,
stiffness and damping says that all three can be scaled together unseen, and that only their ratios are in the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

UNSEEN = 1e-6
"""Singular values below this share of the largest are 0: differences give Jacobians to about 1e-9."""


@dataclass(frozen=True, eq=False)
class Information:
    """A Jacobian of standardised residuals by the logarithms of named parameters, ``(m, p)``, and what follows from it."""

    names: tuple[str, ...]
    jacobian: np.ndarray

    @cached_property
    def _svd(self) -> tuple[np.ndarray, np.ndarray]:
        _, values, rows = np.linalg.svd(self.jacobian, full_matrices=True)
        return np.append(values, np.zeros(len(rows) - len(values))), rows

    @property
    def fisher(self) -> np.ndarray:
        """The Fisher information of the logarithms, ``(p, p)``."""
        return self.jacobian.T @ self.jacobian

    @property
    def rank(self) -> int:
        """How many directions the data see."""
        values, _ = self._svd
        return int((values > UNSEEN * values[0]).sum()) if values[0] > 0 else 0

    @property
    def condition(self) -> float:
        """The largest singular value over the smallest that is seen."""
        values, _ = self._svd
        return float(values[0] / values[self.rank - 1]) if self.rank else np.inf

    @property
    def gauge(self) -> np.ndarray:
        """The directions that the data do not see, as rows, ``(p - rank, p)``."""
        return self._svd[1][self.rank :]

    @cached_property
    def invariants(self) -> np.ndarray:
        """Exponents of the products of powers that the data see, as rows ``(rank, p)``: p unit vectors without a gauge.

        Each gauge direction is led by one parameter; every other parameter is divided by the powers of the leaders that
        scale with it.
        """
        rows = self.gauge.copy()
        leaders: list[int] = []
        for i in range(len(rows)):
            free = [j for j in range(rows.shape[1]) if j not in leaders]
            size = np.abs(rows[i][free])
            # of nearly equal ones the first, so that the words do not depend on rounding
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
        """The invariants in words: ``stiffness/mass``."""
        return [product(self.names, row) for row in self.invariants]

    @property
    def words(self) -> str:
        """What can be known and what cannot, in a sentence."""
        if self.rank == len(self.names):
            return f"{_listed(self.names)} can be told" + (" apart" if len(self.names) > 1 else "")
        hidden = [_direction(self.names, row) for row in self.gauge]
        if not self.rank:
            return f"nothing can be told: the data do not depend on {_listed(self.names)}"
        return f"only {', '.join(self.labels)}: {'; '.join(hidden)} changes nothing"

    def covariance(self) -> np.ndarray:
        """Return the Cramer-Rao bound of the logarithms of the invariants, ``(rank, rank)``."""
        values, rows = self._svd
        kept = rows[: self.rank]
        inverse = (kept.T / values[: self.rank] ** 2) @ kept
        return self.invariants @ inverse @ self.invariants.T


def product(names: tuple[str, ...], exponents: np.ndarray) -> str:
    """Write a product of powers: ``stiffness/mass``, ``damping^2*mass``."""
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


def _direction(names: tuple[str, ...], row: np.ndarray) -> str:
    own = np.abs(row) > 1e-4 * np.abs(row).max()
    moving = [name for name, there in zip(names, own, strict=True) if there]
    if len(moving) == 1:
        return f"{moving[0]}"
    powers = row[own] / row[own][np.argmax(np.abs(row[own]))]
    if np.allclose(powers, 1.0, atol=1e-3):
        return f"scaling {_listed(moving)} together"
    return "scaling " + " with ".join(
        f"{name}{_power(abs(p)) if p > 0 else f'^{p:.3g}'}" for name, p in zip(moving, powers, strict=True)
    )


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
