"""A right, unbiased pathwise gradient of a noisy cost: about 423 samples for 10%, central differences 1,986 pairs."""

import numpy as np

theta = [1.0, 1.0]


def cost(x, w):
    return float((x[0] + 0.5 * np.sum(w)) ** 2 + x[1] * (1 + w[0]))


def gradient(x, w):
    return np.array([2 * (x[0] + 0.5 * np.sum(w)), 1 + w[0]])
