"""Robertson's stiff kinetics by Kvaerno5."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)
about = {
    "package": "diffrax",
    "python": "jax",
    "requires": "diffrax",
    "examine": "grad=jax calls=1500",
    "derivative": "right",
    "how": "SciPy's BDF at 1e-11",
}
theta = np.array([0.04, 3e7, 1e4])


def rates(t, y, k):
    """Return the rates of the three concentrations."""
    return [-k[0] * y[0] + k[2] * y[1] * y[2], k[0] * y[0] - k[1] * y[1] ** 2 - k[2] * y[1] * y[2], k[1] * y[1] ** 2]


def cost(k):
    """Return a squared error of the last concentration after 100 s."""
    term = diffrax.ODETerm(lambda t, y, k: jnp.array(rates(t, y, k)))
    steps = diffrax.PIDController(rtol=1e-6, atol=1e-8)
    start = jnp.array([1.0, 0.0, 0.0])
    return (
        diffrax.diffeqsolve(term, diffrax.Kvaerno5(), 0, 100, 1e-4, start, k, stepsize_controller=steps).ys[0, 2] - 0.5
    ) ** 2


def truth():
    """Return the derivative by another solver."""

    def by(h):
        s = solve_ivp(rates, (0, 100), np.array([1, 0, 0j]), "BDF", args=(theta + h,), rtol=1e-11, atol=1e-15)
        return (s.y[2, -1] - 0.5) ** 2

    return [by(1e-30j * k * e).imag / (1e-30 * k) for k, e in zip(theta, np.eye(3), strict=True)]
