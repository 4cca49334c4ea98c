"""A ball that bounces twice, by `odeint_event`."""

import numpy as np
import torch
from torchdiffeq import odeint, odeint_event

torch.set_default_dtype(torch.float64)
about = {
    "package": "torchdiffeq",
    "python": "torch",
    "requires": "torch==2.13.0 torchdiffeq",
    "examine": "grad=torch calls=400",
    "derivative": "right",
    "how": "closed form",
}
theta = np.array([1.0, 0.3, 0.8])  # height [m], speed [m/s], restitution
END, TOLERANCE = 1.5, {"rtol": 1e-8, "atol": 1e-10}


def fall(t, y):
    """Return the rates of height and speed."""
    return torch.stack([y[1], torch.tensor(-9.81)])


def cost(p):
    """Return the squared distance of the last height to 0.3 m."""
    y, t = p[:2], torch.tensor(0.0)
    for _ in range(2):
        t, ys = odeint_event(fall, y, t, event_fn=lambda t, y: y[0], odeint_interface=odeint, **TOLERANCE)
        y = torch.stack([0 * ys[-1][0] + 1e-10, -p[2] * ys[-1][1]])
    return (odeint(fall, y, torch.stack([t, torch.tensor(END)]), **TOLERANCE)[-1][0] - 0.3) ** 2


def truth():
    """Return the derivative of the closed form."""

    def height(h, v, e):
        speed = np.sqrt(v * v + 2 * 9.81 * h)  # at the first impact
        left = END - (v + speed) / 9.81 - 2 * e * speed / 9.81
        return (e * e * speed * left - 9.81 * left**2 / 2 - 0.3) ** 2

    return [height(*(theta + 1e-30j * e)).imag / 1e-30 for e in np.eye(3)]
