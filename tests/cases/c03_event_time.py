"""diffrax #451, #729: the time of an event is found by a loop, so it carries no gradient.

A ball is thrown from height h with speed (vx, vy); cost = (range - 3)^2, range = vx t_hit.
RIGHT: t = (vy + sqrt(vy^2 + 2 g h)) / g in closed form, differentiated by hand (``exact``). ``frozen`` is what autodiff
gives with t_hit constant. ``counted`` stops at the first step below the ground and returns its time: a staircase.
"""

import numpy as np

G = 9.81
theta = [1.0, 2.0, 1.5]  # h, vx, vy


def hit(x):
    return (x[2] + np.sqrt(x[2] ** 2 + 2 * G * x[0])) / G


def cost(x):
    return (x[1] * hit(x) - 3.0) ** 2


def exact(x):
    root = np.sqrt(x[2] ** 2 + 2 * G * x[0])
    out = 2 * (x[1] * hit(x) - 3.0)
    return out * np.array([x[1] / root, hit(x), x[1] * (1 + x[2] / root) / G])


def frozen(x):
    return 2 * (x[1] * hit(x) - 3.0) * np.array([0.0, hit(x), 0.0])


def counted(x, dt=1e-3):
    t = 0.0
    while x[0] + x[2] * t - G / 2 * t * t > 0:
        t += dt
    return t


def zero(x):
    return np.zeros(3)
