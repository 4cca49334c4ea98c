"""optiland PR #724: a constructor (full_like) detaches an intermediate, so the gradient is 1% off for one input and 43% for the other.

A ray through a lens surface of radius x0 and thickness x1, aimed at the pupil position, which depends weakly on both.
RIGHT: torch without the detach (``attached``); checked by differences.
"""

import torch

theta = [50.0, 5.0]


def height(x, pupil_of):
    n = 1.5
    focal = x[0] / (n - 1)
    pupil = pupil_of(x[1] / n * (1 - x[1] / focal) * 0.12)
    slope = (3.0 + pupil) / 100.0
    y = 2.0
    y1 = y + slope * x[1]
    sag = y1**2 / (2 * x[0]) * (1 + y1**2 / (4 * x[0] ** 2))
    bent = slope / n - y1 / (n * focal)
    y2 = y1 + bent * (x[1] - sag)
    return (y2 + 40 * bent) ** 2


def cost(x):
    return height(x, lambda p: torch.full_like(x[0], p.item()))


def attached(x):
    return height(x, lambda p: p)
