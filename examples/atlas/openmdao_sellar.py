"""Two coupled disciplines (Sellar), by `compute_totals`."""

import numpy as np
import openmdao.api as om

about = {
    "package": "openmdao",
    "python": "plain",
    "requires": "openmdao",
    "examine": "grad=gradient calls=3000",
    "derivative": "right",
    "how": "own iteration",
    "advice": "A run starts from the last one's result, so that equal calls differ by the solver's tolerance.",
}
theta = np.array([5.0, 2.0, 1.0])  # z1, z2, x
problem = om.Problem(reports=False)
for name, formula in {
    "one": "y1 = z1**2 + z2 + x - 0.2 * y2",
    "two": "y2 = y1**0.5 + z1 + z2",
    "goal": "f = x**2 + z2 + y1 + exp(-y2)",
}.items():
    problem.model.add_subsystem(name, om.ExecComp(formula), promotes=["*"])
problem.model.nonlinear_solver = om.NonlinearBlockGS(iprint=-1)
problem.model.linear_solver = om.DirectSolver()
problem.setup()


def cost(p):
    """Return the goal of the coupled disciplines."""
    problem["z1"], problem["z2"], problem["x"] = p
    problem.run_model()
    return problem["f"].item()


def gradient(p):
    """Return the total derivatives."""
    cost(p)
    return problem.compute_totals("f", ["z1", "z2", "x"], return_format="array")[0]


def truth():
    """Return the derivative of the fixed point."""
    z1, z2, x = (theta + 1e-30j * np.eye(3)).T
    y1 = 25.0
    for _ in range(100):
        y2 = y1**0.5 + z1 + z2
        y1 = z1**2 + z2 + x - 0.2 * y2
    return (x**2 + z2 + y1 + np.exp(-y2)).imag / 1e-30
