"""Checks of policies on random observations."""

from __future__ import annotations

import numpy as np

from bench.conformance.kit import require, skip_unless, verifies
from bench.conformance.subjects import ROUNDED, agree, available, rng
from bench.gradient import Options, check
from bench.model import Policy

INPUTS, OUTPUTS, N_COLUMNS = 3, 2, 5
"""Numbers of observations, controls and columns of the checks."""
MANY = 40
"""Number of columns in which every unit of a network is active somewhere."""


def _subject(policy: Policy, columns: int = N_COLUMNS) -> tuple[np.ndarray, np.ndarray]:
    """Return a theta ``(d, N_COLUMNS)`` around the initial one and observations ``(INPUTS, columns)``."""
    random, theta = rng("policy"), policy.initial(INPUTS, OUTPUTS)
    spread = 0.1 * random.standard_normal((len(theta), N_COLUMNS))
    return theta[:, None] + spread, random.standard_normal((INPUTS, columns))


@verifies(Policy)
def theta_has_the_declared_shapes(policy: Policy) -> str:
    """Verify that the initial theta is a finite vector of the declared length, the same at every call."""
    theta = policy.initial(INPUTS, OUTPUTS)
    size = policy.size(INPUTS, OUTPUTS)
    require(theta.shape == (size,), f"theta is {theta.shape}, and its shapes have {size} numbers")
    require(theta.dtype == np.float64 and np.isfinite(theta).all(), "theta must be finite and of type float64")
    require(np.array_equal(theta, policy.initial(INPUTS, OUTPUTS)), "the initial theta differs between calls")
    return ", ".join(f"{name} {shape}" for name, shape in policy.shapes(INPUTS, OUTPUTS).items())


@verifies(Policy)
def shared_theta_acts_like_columns(policy: Policy) -> str:
    """Verify that a theta ``(d, 1)`` and the same theta repeated ``(d, B)`` give the same controls ``(n_outputs, B)``."""
    theta, observations = _subject(policy)
    shared = policy.act(np, theta[:, :1], observations)
    repeated = policy.act(np, np.repeat(theta[:, :1], N_COLUMNS, axis=1), observations)
    require(shared.shape == (OUTPUTS, N_COLUMNS), f"controls are {shared.shape}, not {(OUTPUTS, N_COLUMNS)}")
    agree(shared, repeated, ROUNDED, "a shared theta and its copies differ")
    changed = observations.copy()
    changed[:, 2] += 1.0
    others = np.arange(N_COLUMNS) != 2
    off = agree(
        policy.act(np, theta, changed)[:, others],
        policy.act(np, theta, observations)[:, others],
        ROUNDED,
        "a column changes the controls of others",
    )
    return f"to {off:.0e}"


@verifies(Policy)
def derivatives_agree(policy: Policy) -> str:
    """Verify that JAX and central differences agree on the derivatives by theta, and that theta moves the controls."""
    skip_unless("jax" in {backend.name for backend in available("backends")}, "JAX is not installed")
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    theta, observations = _subject(policy, MANY)
    weights = rng("weights").standard_normal((OUTPUTS, MANY))

    def cost(thetas: np.ndarray) -> np.ndarray:
        return np.array([(weights * policy.act(np, theta[:, None], observations)).sum() for theta in thetas.T])

    exact = jax.jit(jax.grad(lambda theta: (weights * policy.act(jnp, theta[:, None], observations)).sum()))
    found = check(cost, lambda theta: np.asarray(exact(theta)), theta[:, 0], Options(draws=0))
    require(found.trusted, found.sentence())
    share = np.mean(np.asarray(exact(theta[:, 0])) != 0.0)  # a rectified unit may be always inactive
    # least share of the parameters that must move a control
    require(share > 0.75, f"only {share:.0%} of {len(theta)} parameters move a control")
    return f"{len(theta)} parameters, {found.cause}"
