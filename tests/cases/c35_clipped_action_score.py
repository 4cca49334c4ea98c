"""score function evaluated at the clipped action (Stable-Baselines / brax style reports, CAPG). J = E[r(clip(mu+w))]. Right: d/dmu by Gauss quadrature; the estimator with the unclipped action is unbiased."""

import numpy as np

theta = [0.6]


def cost(x, w):
    return float((np.clip(x[0] + w[0], -1, 1) + 0.2) ** 2 + 1.0)


def clipped(x, w):
    a = np.clip(x[0] + w[0], -1, 1)
    return [cost(x, w) * (a - x[0])]


def unclipped(x, w):
    return [cost(x, w) * w[0]]


def pathwise(x, w):
    a = x[0] + w[0]
    return [2 * (a + 0.2) if abs(a) < 1 else 0.0]
