"""A decaying Taylor-Green vortex (pseudo-spectral)."""

import jax
import jax.numpy as jnp
import jax_cfd.base as cfd
import numpy as np
from jax_cfd import spectral

jax.config.update("jax_enable_x64", True)
about = {
    "package": "jax-cfd",
    "python": "jax",
    "requires": "jax-cfd",
    "examine": "grad=jax sigma=0.01 horizons=10,50,200 calls=1500",
    "derivative": "right",
    "use": "usable",
    "how": "the exact solution",
}
theta = np.array([1.0, 0.05])
GRID = cfd.grids.Grid((32, 32), domain=((0, 2 * np.pi), (0, 2 * np.pi)))
X, Y = (np.array(axis) for axis in GRID.mesh(offset=(0.5, 0.5)))


def cost(p, steps=50):
    """Return the mean squared vorticity after steps of 0.01."""
    equation = spectral.equations.NavierStokes2D(p[1], GRID, smooth=True)
    one = spectral.time_stepping.crank_nicolson_rk4(equation, 0.01)
    start = jnp.fft.rfftn(p[0] * np.sin(2 * X) * np.sin(2 * Y))
    return jnp.mean(jnp.fft.irfftn(cfd.funcutils.repeated(one, steps)(start)) ** 2)


def truth():
    """Return the derivative of amplitude^2 exp(-16 viscosity t) / 4."""
    amplitude, viscosity = (theta + 1e-30j * np.eye(2)).T
    return (amplitude**2 * np.exp(-16 * viscosity * 0.5) / 4).imag / 1e-30
