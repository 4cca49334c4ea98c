"""Two events that swap their order near theta: jumps of both signs partly cancel, the bias at sigma = 0.3 is 7.3%."""

theta = [1.0]


def cost(x):
    q1 = q2 = 0.0
    s, a, b = 1.0, False, False
    for _ in range(50):
        q1 += 0.04 * x[0]
        q2 += 0.04
        if q1 > 1.0 and not a:
            s, a = s * 0.5, True
        if q2 > 1.02 and not b:
            s, b = s + 0.4, True
    return s + 0.2 * x[0] ** 2


def gradient(x):
    return [0.4 * x[0]]
