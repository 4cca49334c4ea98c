"""The lift of a wing (vortex lattice), by CasADi's derivatives."""

import aerosandbox as asb
import casadi as ca
import numpy as np

about = {
    "package": "aerosandbox",
    "python": "plain",
    "requires": "aerosandbox",
    "examine": "grad=gradient calls=600",
    "derivative": "right",
    "how": "the package on NumPy, by complex numbers",
}
theta = np.array([5.0, 1.0])  # degrees, m


def lift(p):
    """Return the lift coefficient, of numbers or of CasADi's symbols."""
    foil = asb.Airfoil("naca2412")
    root, tip = (asb.WingXSec([0.1 * y, y, 0], k * p[1], airfoil=foil) for y, k in ((0, 1), (2, 0.6)))
    plane = asb.Airplane(wings=[asb.Wing(symmetric=True, xsecs=[root, tip])], s_ref=2, c_ref=1, b_ref=4)
    at = asb.OperatingPoint(velocity=20, alpha=p[0])
    return asb.VortexLatticeMethod(plane, at, spanwise_resolution=4, chordwise_resolution=2).run()["CL"]


q = ca.MX.sym("q", 2)
slope = ca.Function("slope", [q], [ca.jacobian(lift(q), q)])
cost = lambda p: float(lift(p))
gradient = lambda p: np.array(slope(p))[0]


def truth():
    """Return the derivative by complex numbers."""
    return [lift(theta + 1e-30j * e).imag / 1e-30 for e in np.eye(2)]
