"""The projection onto the simplex as a layer."""

import cvxpy as cp
import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer

torch.set_default_dtype(torch.float64)
about = {
    "package": "cvxpylayers",
    "python": "torch",
    "requires": "torch==2.13.0 cvxpylayers",
    "examine": "grad=torch calls=600",
    "derivative": "right",
    "how": "closed form of the active set",
    "advice": "The solver stops early: inputs without effect have a derivative of 0 and differences of 1e-6. With `atol=1e-5` it is right.",
}
theta = np.array([0.9, 0.6, -0.4, 0.3, -0.8])
x, given = cp.Variable(5), cp.Parameter(5)
problem = cp.Problem(cp.Minimize(cp.sum_squares(x - given)), [x >= 0, cp.sum(x) == 1])
layer = CvxpyLayer(problem, parameters=[given], variables=[x])
TARGET = np.array([0.1, 0.7, 0.1, 0.1, 0.0])


def cost(p):
    """Return the squared distance of the projection from a target."""
    return ((layer(torch.as_tensor(p))[0] - torch.as_tensor(TARGET)) ** 2).sum()


def truth():
    """Return the derivative: with the k largest active, each is p less their mean excess."""
    largest = np.sort(theta)[::-1]
    excess = (np.cumsum(largest) - 1) / np.arange(1, 6)
    k = np.flatnonzero(largest > excess)[-1]
    active = theta > excess[k]
    slope = active * (theta - excess[k] - TARGET) * 2
    return slope - active * slope.sum() / active.sum()
