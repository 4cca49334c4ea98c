"""The Lorenz system by `odeint_adjoint` at default tolerances."""

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torchdiffeq import odeint_adjoint

torch.set_default_dtype(torch.float64)
about = {
    "package": "torchdiffeq",
    "python": "torch",
    "requires": "torch==2.13.0 torchdiffeq",
    "examine": "grad=gradient calls=400",
    "derivative": "wrong",
    "how": "SciPy's DOP853 at 1e-12",
    "advice": "`odeint_adjoint` solves backward in time; where this is unstable, tolerances of 1e-11 or `odeint` give the right gradient.",
}
theta = np.array([10.0, 28.0, 8 / 3])


def rates(t, y, p):
    """Return the rates of the three coordinates."""
    return [p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]]


def last(p, solve=odeint_adjoint):
    """Return the last z of a module with parameters p, and the parameters."""
    model = torch.nn.Module()
    model.p = torch.nn.Parameter(torch.as_tensor(p))
    model.forward = lambda t, y: torch.stack(rates(t, y, model.p))
    return solve(model, torch.ones(3), torch.tensor([0.0, 1.5]))[-1][2], model.p


def cost(p):
    """Return the last z."""
    return last(p)[0].item()


def gradient(p):
    """Return the derivative by the adjoint."""
    return torch.autograd.grad(*last(p))[0].numpy()


def truth():
    """Return the derivative by another solver."""
    ends = [
        solve_ivp(rates, (0, 1.5), np.ones(3) + 0j, "DOP853", args=(theta + 1e-30j * e,), rtol=1e-12, atol=1e-14)
        for e in np.eye(3)
    ]
    return [s.y[2, -1].imag / 1e-30 for s in ends]
