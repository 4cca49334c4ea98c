"""Counts MuJoCo steps whose finite difference spans a contact switch: `python validation/straddled.py`.

The scene is the tossed box.
The Jacobians of single steps from differences of 1e-6, 1e-7 and 1e-8 are compared with Jacobians from 1e-8, and the gradients
with differences of whole rollouts.
"""

import numpy as np

from bench.model import compose, registry

DRAWS = 48
APART = 1e-3
"""Absolute difference of two Jacobians of one step above rounding; ten times it is the relative limit for gradients."""
FINE = 1e-8


def problem(step):
    """Return the problem of the tossed box in MuJoCo, with Jacobians from differences of ``step``."""
    scene = registry.make("scenes", "tossed_box", {})
    law = registry.make("contacts", "penalty", scene.contact_values)
    backend = registry.make("backends", "mujoco", {"step": step})
    return backend.compile(compose(scene, law, registry.make("integrators", "semi_implicit_euler", {})))


def draws(of, count):
    """Return ``count`` thetas ``(d, B)`` and noise ``(n_w, B)``, the same for any difference step."""
    w = np.random.default_rng(0).standard_normal((of.program.n_noise, count))
    return np.repeat(of.program.theta0[:, None], count, axis=1), w


def straddled(step, count=DRAWS):
    """Return which time steps have another Jacobian than with differences of :data:`FINE`, ``(T, B)``."""
    found = [one.jacobians(*draws(one, count)).a for one in (problem(step), problem(FINE))]
    return np.abs(found[0] - found[1]).max(axis=(1, 2)) > APART


def wrong(step, count=DRAWS):
    """Return which gradients differ by more than 1% from differences of the whole rollout, ``(B,)``."""
    of = problem(step)
    theta, w = draws(of, count)
    h = 1e-7
    rows = [
        (of.value(theta + h * e[:, None], w) - of.value(theta - h * e[:, None], w)) / (2 * h)
        for e in np.eye(len(theta))
    ]
    whole = np.stack(rows)
    return np.linalg.norm(of.grad(theta, w) - whole, axis=0) > 10 * APART * np.linalg.norm(whole, axis=0)


if __name__ == "__main__":
    for step in (1e-6, 1e-7, 1e-8):
        steps = straddled(step)
        print(
            f"differences of {step:g}: {steps.sum()} of {steps.size} steps have another Jacobian than those of {FINE:g}; "
            f"{wrong(step).sum()} of {DRAWS} gradients are off by over 1% from differences of the whole rollout"
        )
