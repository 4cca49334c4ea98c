"""A guarded sigmoid whose gradient is NaN below about -0.67 (1.3% of samples at sigma = 0.3), the cost a number."""

import torch

theta = [0.0]


def cost(x):
    return 0.001 * x[0] + 1 / (1 + torch.exp(-(x[0] - 0.75) / 0.002))
