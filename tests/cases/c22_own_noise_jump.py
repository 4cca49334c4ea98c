"""pyro #2277, second form: the jump lies in the program's own noise, and the smooth part has a slope of its own.

cost(theta, w) = 0.1 theta + [theta + w > 0.5] (n = 1). ``pathwise`` = 0.1 is the right derivative for almost every w.
RIGHT: d/dtheta E = 0.1 + phi(0.5 - theta) = 0.1 + phi(0.2) = 0.49104: the pathwise gradient of E is 80% short.
``many`` has 20 steps of w, each of which may cross a threshold: d/dtheta E = 0.1 + phi(0.2) as well (mean of 20 indicators).
"""

import numpy as np

theta = [0.3]


def cost(x, w):
    return 0.1 * x[0] + (x[0] + w[0] > 0.5)


def many(x, w):
    return 0.1 * x[0] + np.mean(x[0] + w > 0.5)


def pathwise(x, w):
    return [0.1]
