"""Covariance matrix adaptation."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.model import Answer, OptimizerState, Population, param


class Constants(NamedTuple):
    """The strategy's constants for a dimension and a population (Hansen 2016, arXiv 1604.00772, table 1).

    ``c_sigma`` has the denominator d + mu_eff + 3, as in the author's own program, instead of the table's d + mu_eff
    + 5, and is at most 1/2.
    """

    weights: np.ndarray
    mu_eff: float
    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    chi: float
    """Expected norm of a standard normal vector."""


def constants(dim: int, population: int) -> Constants:
    """Return the default constants, with weights for the better half of the population only."""
    raw = math.log((population + 1) / 2) - np.log(np.arange(1, population // 2 + 1))
    weights = raw / raw.sum()
    mu_eff = float(1 / (weights**2).sum())
    c_sigma = min(0.5, (mu_eff + 2) / (dim + mu_eff + 3))
    d_sigma = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (dim + 1)) - 1) + c_sigma
    c_c = (4 + mu_eff / dim) / (dim + 4 + 2 * mu_eff / dim)
    c_1 = 2 / ((dim + 1.3) ** 2 + mu_eff)
    c_mu = min(1 - c_1, 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((dim + 2) ** 2 + mu_eff))
    chi = math.sqrt(dim) * (1 - 1 / (4 * dim) + 1 / (21 * dim**2))
    return Constants(weights, mu_eff, c_sigma, d_sigma, c_c, c_1, c_mu, chi)


@dataclass(frozen=True)
class CmaEs(Population):
    """CMA-ES (Hansen 2016): adapts mean, step size and full covariance of a normal distribution to the better half.

    Stores d^2 numbers and needs d^3 operations per iteration. Points without a finite cost are ranked last.
    """

    name = "cma_es"

    population: int | None = param(  # type: ignore[assignment]
        None, "points per iteration; null: 4 + 3 ln d", low=4
    )
    width: float = param(0.3, "initial step size, in units of theta", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: mean theta, step size ``width``, unit covariance."""
        d = len(theta)
        paths = {"path_sigma": np.zeros(d), "path_c": np.zeros(d)}
        root = {"covariance": np.eye(d), "axes": np.eye(d), "lengths": np.ones(d)}
        return super().start(theta) | paths | root | {"sigma": self.width, "iteration": 0}

    def draws(self, dim: int) -> int:
        return self.population or 4 + math.floor(3 * math.log(dim))

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        moved = state["axes"] @ (state["lengths"][:, None] * noise)
        return state["theta"][:, None] + state["sigma"] * moved

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        d, i = theta.shape[0], state["iteration"] + 1
        k = constants(d, theta.shape[1])
        y = (self.best(theta, answer, k.weights.size) - state["theta"][:, None]) / state["sigma"]
        step = y @ k.weights
        axes, lengths = state["axes"], state["lengths"]
        white = axes @ ((axes.T @ step) / lengths)
        path_sigma = (1 - k.c_sigma) * state["path_sigma"] + math.sqrt(k.c_sigma * (2 - k.c_sigma) * k.mu_eff) * white
        norm = float(np.linalg.norm(path_sigma))
        is_settled = norm / math.sqrt(1 - (1 - k.c_sigma) ** (2 * i)) < (1.4 + 2 / (d + 1)) * k.chi
        path_c = (1 - k.c_c) * state["path_c"] + is_settled * math.sqrt(k.c_c * (2 - k.c_c) * k.mu_eff) * step
        lost = (1 - is_settled) * k.c_1 * k.c_c * (2 - k.c_c)
        covariance = (
            (1 - k.c_1 - k.c_mu + lost) * state["covariance"]
            + k.c_1 * np.outer(path_c, path_c)
            + k.c_mu * (y * k.weights) @ y.T
        )
        squares, axes = np.linalg.eigh((covariance + covariance.T) / 2)
        sigma = state["sigma"] * math.exp(min(1.0, k.c_sigma / k.d_sigma * (norm / k.chi - 1)))
        return {
            "theta": state["theta"] + state["sigma"] * step,
            "sigma": sigma,
            "covariance": covariance,
            "axes": axes,
            "lengths": np.sqrt(np.maximum(squares, 1e-20)),
            "path_sigma": path_sigma,
            "path_c": path_c,
            "iteration": i,
        }
