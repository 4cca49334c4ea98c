"""Two species that react, by IDAKLU and its sensitivities."""

import numpy as np
import pybamm
from scipy.integrate import solve_ivp

about = {
    "package": "pybamm",
    "python": "pybamm",
    "requires": "pybamm",
    "examine": "grad=gradient calls=600",
    "derivative": "right",
    "how": "SciPy's DOP853 at 1e-12",
}
theta = np.array([0.8, 0.3])
model, x, y = pybamm.BaseModel(), pybamm.Variable("x"), pybamm.Variable("y")


def rates(t, z, k):
    """Return the rates of both concentrations."""
    return [-k[0] * z[0] * z[1], k[0] * z[0] * z[1] - k[1] * z[1]]


model.rhs = dict(zip((x, y), rates(0, (x, y), (pybamm.InputParameter("a"), pybamm.InputParameter("b"))), strict=True))
model.initial_conditions, model.variables = {x: pybamm.Scalar(2), y: pybamm.Scalar(0.1)}, {"y": y}
pybamm.Discretisation().process_model(model)
solver = pybamm.IDAKLUSolver(rtol=1e-8, atol=1e-10)


def solution(p, with_slopes=False):
    """Return the second concentration over 5 units of time."""
    inputs = {"a": p[0], "b": p[1]}
    return solver.solve(model, np.array([0.0, 5.0]), inputs=inputs, calculate_sensitivities=with_slopes)["y"]


cost = lambda p: float(solution(p).data[-1])
gradient = lambda p: [float(np.ravel(solution(p, True).sensitivities[name])[-1]) for name in ("a", "b")]


def truth():
    """Return the derivative by another solver."""
    at = [theta + 1e-30j * e for e in np.eye(2)]
    ends = [solve_ivp(rates, (0, 5), [2 + 0j, 0.1], "DOP853", args=(k,), rtol=1e-12, atol=1e-14) for k in at]
    return [s.y[1, -1].imag / 1e-30 for s in ends]
