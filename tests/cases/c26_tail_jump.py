"""A jump of 30 at 3.5 sigma (sigma = 0.1): J' = 1 + 30 phi(3.5)/0.1 = 1.262, so the mean gradient is off by 20.7%."""

theta = [0.0]


def cost(x):
    return float(x[0] + 30.0 * (x[0] > 0.35))


def gradient(x):
    return [1.0]
