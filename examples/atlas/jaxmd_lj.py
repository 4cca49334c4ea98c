"""Lennard-Jones energy by sigma and epsilon."""

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import energy, space

jax.config.update("jax_enable_x64", True)
about = {
    "package": "jax-md",
    "python": "jax",
    "requires": "jax-md",
    "examine": "grad=jax calls=400",
    "derivative": "wrong",
    "how": "own sum over pairs",
    "advice": "Reverse mode by sigma or epsilon is NaN (issue 258 of jax-md/jax-md), also of `lennard_jones_pair`; `jax.jacfwd` is right.",
}
theta = np.array([1.0, 1.0])
CELLS = np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2)
PLACES = 1.25 * (CELLS + 0.5) + 0.1 * np.random.default_rng(1).standard_normal((64, 2))
neighbours, potential = energy.lennard_jones_neighbor_list(space.periodic(10.0)[0], 10.0)
LIST = neighbours.allocate(PLACES)


def cost(p):
    """Return the energy of a particle."""
    return potential(jnp.array(PLACES), neighbor=LIST, sigma=p[0], epsilon=p[1]) / 64


def truth():
    """Return the derivative; the energy is cut off smoothly from 2 to 2.5."""
    d = (PLACES[:, None] - PLACES)[np.triu_indices(64, 1)]
    q = np.sum((d - 10 * np.round(d / 10)) ** 2, 1)
    cut = np.where(q < 4, 1, np.where(q < 6.25, (6.25 - q) ** 2 * (2 * q - 5.75) / 2.25**3, 0))
    sigma, epsilon = (theta + 1e-30j * np.eye(2)).T[:, :, None]
    return np.sum(cut * 4 * epsilon * ((sigma**2 / q) ** 6 - (sigma**2 / q) ** 3), 1).imag / 64e-30
