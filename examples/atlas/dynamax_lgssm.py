"""The likelihood of 100 observations by a Kalman filter."""

import jax
import jax.numpy as jnp
import numpy as np
from dynamax.linear_gaussian_ssm import LinearGaussianSSM

jax.config.update("jax_enable_x64", True)
about = {
    "package": "dynamax",
    "python": "jax",
    "requires": "dynamax",
    "examine": "grad=jax sigma=0.1 calls=3000",
    "derivative": "right",
    "use": "usable",
    "how": "own filter",
}
theta = np.array([-2.0, -3.0, 0.1])  # logs of process and observation noise, damping
SEEN = np.cumsum(np.random.default_rng(0).standard_normal(100)) * 0.1
model = LinearGaussianSSM(2, 1)
SEES = np.array([[1.0, 0.0]])
start = {"initial_mean": jnp.zeros(2), "initial_covariance": jnp.eye(2), "emission_weights": jnp.array(SEES)}
usual, _ = model.initialize(jax.random.key(0), emission_bias=jnp.zeros(1), dynamics_bias=jnp.zeros(2), **start)


def cost(p):
    """Return minus the log-likelihood."""
    weights = jnp.array([[1.0, 0.1], [0.0, 1.0]]) - p[2] * jnp.diag(jnp.array([0.0, 1.0]))
    dynamics = usual.dynamics._replace(weights=weights, cov=jnp.exp(p[0]) * jnp.eye(2) * 0.1)
    emissions = usual.emissions._replace(cov=jnp.exp(p[1]) * jnp.eye(1))
    return -model.marginal_log_prob(usual._replace(dynamics=dynamics, emissions=emissions), jnp.array(SEEN[:, None]))


def truth():
    """Return the derivative of an own filter."""

    def total(p, m=np.zeros(2), cov=np.eye(2), sum_=0.0):  # noqa: B008
        moves = np.array([[1, 0.1], [0, 1 - p[2]]])
        for y in SEEN:
            spread, gain = (SEES @ cov @ SEES.T + np.exp(p[1]))[0, 0], cov @ SEES[0]
            off, sum_ = y - m[0], sum_ + np.log(2 * np.pi * spread) / 2 + (y - m[0]) ** 2 / spread / 2
            m, cov = moves @ (m + gain * off / spread), moves @ (cov - np.outer(gain, gain) / spread) @ moves.T
            cov = cov + np.exp(p[0]) * np.eye(2) * 0.1
        return sum_

    return [total(theta + 1e-30j * e).imag / 1e-30 for e in np.eye(3)]
