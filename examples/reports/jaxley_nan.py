"""Jaxley 0.14.0: a cell that starts at exactly -55 or -40 mV is NaN.

``_vtrap`` of ``jaxley/channels/hh.py`` is 0/0 there, and the limit of x / (exp(x / y) - 1) at 0 is y. One step from -70 mV gives
-69.488 mV.
"""

import jaxley as jx

for v in (-70.0, -55.0, -40.0):
    cell = jx.Compartment()
    cell.insert(jx.channels.HH())
    cell.set("v", v)
    cell.record("v", verbose=False)
    cell.stimulate(jx.step_current(1.0, 1.0, 0.01, 0.025, 2.0), verbose=False)
    print(v, jx.integrate(cell, delta_t=0.025)[0][1])
