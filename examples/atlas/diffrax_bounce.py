"""A ball that bounces twice, by events with a root finder."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

jax.config.update("jax_enable_x64", True)
about = {
    "package": "diffrax",
    "python": "jax",
    "requires": "diffrax",
    "examine": "grad=jax calls=1500",
    "derivative": "right",
    "how": "closed form",
}
theta = np.array([1.0, 0.3, 0.8])  # height [m], speed [m/s], restitution
END = 1.5
EVENT = diffrax.Event(lambda t, y, args, **_: y[0], optimistix.Newton(1e-10, 1e-10), direction=False)


def cost(p):
    """Return the squared distance of the last height to 0.3 m."""
    y, t, term = p[:2], 0.0, diffrax.ODETerm(lambda t, y, a: jnp.array([y[1], -9.81]))
    steps = diffrax.PIDController(rtol=1e-8, atol=1e-10)
    for event in (EVENT, EVENT, None):
        s = diffrax.diffeqsolve(term, diffrax.Tsit5(), t, END, 0.01, y, stepsize_controller=steps, event=event)
        y, t = jnp.array([1e-12, -p[2] * s.ys[0, 1]]), s.ts[0]
    return (s.ys[0, 0] - 0.3) ** 2


def truth():
    """Return the derivative of the closed form."""

    def height(h, v, e):
        speed = np.sqrt(v * v + 2 * 9.81 * h)  # at the first impact
        left = END - (v + speed) / 9.81 - 2 * e * speed / 9.81
        return (e * e * speed * left - 9.81 * left**2 / 2 - 0.3) ** 2

    return [height(*(theta + 1e-30j * e)).imag / 1e-30 for e in np.eye(3)]
