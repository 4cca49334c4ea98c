"""Van der Pol by CVODES and its sensitivities."""

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

about = {
    "package": "casadi",
    "python": "plain",
    "requires": "casadi",
    "examine": "grad=gradient refined=refined calls=2500",
    "derivative": "right",
    "how": "SciPy's DOP853 at 1e-12",
    "advice": "At a tolerance of 1e-6 the gradient is right to 0.03%, but differences of the cost are off by up to 33% and decide nothing. At 1e-9 "
    "`examine` shows that it is right.",
}
theta = np.array([5.0, 2.0, 0.1])  # mu, first state
x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 3)


def rates(t, y, mu):
    """Return the rates of position and speed."""
    return [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]]


def speed(tol):
    """Return a function for the last speed, and its derivative."""
    dae = {"x": x, "p": p, "ode": ca.vertcat(*rates(0, x, p[0]))}
    solver = ca.integrator("solver", "cvodes", dae, 0, 12, {"reltol": tol, "abstol": tol / 100})
    q = ca.MX.sym("q", 3)
    last = solver(x0=q[1:], p=q)["xf"][1]
    return ca.Function("cost", [q], [last]), ca.Function("gradient", [q], [ca.jacobian(last, q)])


(usual, slope), (fine, _) = speed(1e-6), speed(1e-11)
cost = lambda q: float(usual(q))
refined = lambda q: float(fine(q))
gradient = lambda q: np.array(slope(q))[0]


def truth():
    """Return the derivative by another solver."""
    at = [theta + 1e-30j * e for e in np.eye(3)]
    ends = [solve_ivp(rates, (0, 12), q[1:], "DOP853", args=(q[0],), rtol=1e-12, atol=1e-14) for q in at]
    return [s.y[1, -1].imag / 1e-30 for s in ends]
