"""kornia #4007, the usual workaround: acos(clamp(w, -1 + 1e-7, 1 - 1e-7)) has no NaN, and no gradient within 9e-4 rad.

theta = rotation vector of the pose error, 3e-4 rad from the target, plus one length; cost = angle^2 + 0.01 (length - 1)^2.
RIGHT: the program's derivative by the rotation is exactly 0 here (the input is clipped), and that of angle^2 is 2 theta:
the pose cannot converge further. Under sigma = 0.001 grad J by the rotation is not 0.
"""

import torch

theta = [2e-4, -2e-4, 1e-4, 0.7]


def cost(x):
    half = torch.sqrt(torch.sum(x[:3] ** 2)) / 2
    angle = 2 * torch.acos(torch.clamp(torch.cos(half), -1 + 1e-7, 1 - 1e-7))
    return angle**2 + 0.01 * (x[3] - 1) ** 2
