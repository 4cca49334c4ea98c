"""gradient with respect to log(p) returned for p (the Jacobian of the transform is missing). Right: closed form."""

import numpy as np

theta = {"mass": 2.5, "damping": 0.04, "stiffness": 300.0}


def cost(p):
    return float(np.exp(-p["damping"] * 3) * np.sqrt(p["stiffness"] / p["mass"]))


def right(p):
    c = cost(p)
    return {"mass": -c / 2 / p["mass"], "damping": -3 * c, "stiffness": c / 2 / p["stiffness"]}


def logged(p):
    g = right(p)
    return {n: g[n] * p[n] for n in g}


def degrees(p):
    g = right(p)
    return {**g, "damping": g["damping"] * 57.29577951308232}
