"""A double well by `sdeint`."""

import numpy as np
import torch
import torchsde

torch.set_default_dtype(torch.float64)
about = {
    "package": "torchsde",
    "python": "torch",
    "requires": "torch==2.13.0 torchsde",
    "examine": "grad=gradient calls=300",
    "derivative": "right",
    "how": "own midpoint scheme of the same increments",
}
theta, N = np.array([1.0, 1.0, 0.4]), 100  # slopes of the well, noise; steps
NOISE = torchsde.BrownianInterval(0.0, 2.0, (8, 1), dtype=torch.float64, entropy=3)


def mean(p, solve):
    """Return the mean squared last position, and the parameters."""
    model = torch.nn.Module()
    model.p, model.noise_type, model.sde_type = torch.nn.Parameter(torch.as_tensor(p)), "diagonal", "stratonovich"
    model.f, model.g = lambda t, y: model.p[0] * y - model.p[1] * y**3, lambda t, y: model.p[2] * torch.ones_like(y)
    y = solve(model, torch.full((8, 1), 0.1), torch.tensor([0.0, 2.0]), bm=NOISE, dt=2.0 / N, method="midpoint")
    return (y[-1] ** 2).mean(), model.p


def cost(p):
    """Return the mean squared last position."""
    return mean(p, torchsde.sdeint)[0].item()


def gradient(p, solve=torchsde.sdeint):
    """Return the derivative by backpropagation."""
    return torch.autograd.grad(*mean(p, solve))[0].numpy()


def truth():
    """Return the derivative of the mean along the same paths."""
    y, (a, b, s) = 0.1 + 0j, (theta + 1e-30j * np.eye(3)).T[:, :, None]
    for t in 2.0 / N * np.arange(N):
        w = NOISE(t, t + 2.0 / N).numpy().T
        middle = y + (a * y - b * y**3) / N + s * w / 2
        y = y + 2 * (a * middle - b * middle**3) / N + s * w
    return np.mean(y**2, axis=1).imag / 1e-30
