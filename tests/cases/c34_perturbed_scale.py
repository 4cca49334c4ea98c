"""google-deepmind/optax#1308: perturbed function's gradient short by sigma = 0.1: f(x + s w) w instead of / s. J = E (x + 0.1 w)^2, dJ = 2x = 2. Right: closed form; / s is unbiased."""

theta = [1.0]


def cost(x, w):
    return (x[0] + 0.1 * w[0]) ** 2


def scaled(x, w):
    return [(cost(x, w) - x[0] ** 2) * w[0]]


def right(x, w):
    return [(cost(x, w) - x[0] ** 2) * w[0] / 0.1]


def pathwise(x, w):
    return [2 * (x[0] + 0.1 * w[0])]
