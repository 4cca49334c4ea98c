"""x[0] has the wrong sign, x[1] is dropped: the headline's verdict and its numbers are of one component."""

theta = [1.0, 2.0]


def cost(x):
    return 5 * x[0] ** 2 + 0.01 * x[1] ** 2


def gradient(x):
    return [-10 * x[0], 0.0]
