"""A Hodgkin-Huxley compartment that spikes, by its conductances."""

import jax
import jax.numpy as jnp
import jaxley as jx
import numpy as np

jax.config.update("jax_enable_x64", True)
about = {
    "package": "jaxley",
    "python": "jax",
    "requires": "jaxley",
    "examine": "grad=jax calls=3000",
    "derivative": "right",
    "how": "own scheme",
    "advice": "A cell that starts at exactly -55 or -40 mV is NaN from its first step: the rates of `HH` are 0/0 there.",
}
theta, DT = {"HH_gNa": 0.12, "HH_gK": 0.036, "HH_gLeak": 0.0003}, 0.025
cell = jx.Cell(jx.Branch(jx.Compartment(), ncomp=1), parents=[-1])
cell.insert(jx.channels.HH())
cell.stimulate(jx.step_current(i_delay=1.0, i_dur=30.0, i_amp=0.05, delta_t=DT, t_max=20.0), verbose=False)
cell.record("v", verbose=False)
for name in theta:
    cell.make_trainable(name, verbose=False)


def cost(p):
    """Return the mean voltage of the last 2 of 20 ms."""
    return jnp.mean(jx.integrate(cell, params=[{n: g[None]} for n, g in p.items()], delta_t=DT)[0, -80:])


def truth():
    """Return the derivative: gates by exponential, voltage by implicit Euler."""
    g = np.array([[*theta.values()]]).T + 1e-30j * np.eye(3)
    v, gates, voltages = np.full(3, -70.0), [0.2] * 3, []
    ramp = lambda x: x / (1 - np.exp(-x / 10))
    for i in range(801):
        up = ramp(v + 40) / 10, 0.07 * np.exp(-(v + 65) / 20), ramp(v + 55) / 100
        down = 4 * np.exp(-(v + 65) / 18), 1 / (1 + np.exp(-(v + 35) / 10)), np.exp(-(v + 65) / 80) / 8
        ends = [a / (a + b) for a, b in zip(up, down, strict=True)]
        gates = [y + (x - y) * np.exp(-DT * a / y) for x, y, a in zip(gates, ends, up, strict=True)]
        now = 1000 * g * [gates[0] ** 3 * gates[1], gates[2] ** 4, np.ones(3)]
        v = (v + DT * (500 / (2 * np.pi) * (i > 39) + [50, -77, -54.3] @ now)) / (1 + DT * now.sum(0))
        voltages.append(v)
    return np.mean(voltages[-80:], 0).imag / 1e-30
