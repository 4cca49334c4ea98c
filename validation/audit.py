"""Compares references of scenes without closed form with a second implementation: `python validation/audit.py`.

The code below imports no statistics, scene or contact law of this package.
"""

import math
import sys

import numpy as np
from scipy import special

from bench.measure.reference import certify
from bench.model import compose, registry


def _block(theta):
    """Return the costs ``(B,)`` of a block dragged with friction, for ``(V, a)`` in columns ``(2, B)``, defaults of the scene."""
    dt, mass, g, mu, slip, k, depth, w, stiffness = 1e-3, 1.0, 9.81, 0.5, 0.005, 400.0, 9.81e-5, 8.0, 1e5
    x, z, vx, vz = np.zeros(theta.shape[1]), np.full(theta.shape[1], -depth), 0.0, 0.0
    for i in range(1500):
        end = theta[0] * (i * dt - theta[1] * math.sin(w * i * dt) / w)
        normal = np.maximum(-stiffness * z, 0.0)
        ax = (k * (end - x) - mu * normal * np.tanh(vx / slip)) / mass
        vx, vz = vx + dt * ax, vz + dt * (normal / mass - g)
        x, z = x + dt * vx, z + dt * vz
    return 0.5 * ((x - 1.0) ** 2 + z**2)


def _hop(theta, noise, kappa=0.0):
    """Return the costs ``(B,)`` of a hopper with forces ``noise (horizon, B)``, with a spring or on the central path."""
    dt, big, small, rest, k, b, g, target, effort, stiffness = 2e-3, 1.0, 0.1, 0.5, 400.0, 6.0, 9.81, 0.7, 1e-5, 1e4
    y = np.full(noise.shape[1], 0.15)
    z, vz, vy = y + rest, 0.0 * y, 0.0 * y
    total = 0.0 * y

    def height(z, y, vz):
        return z + vz**2 / (2 * g) + k * (rest - (z - y)) ** 2 / (2 * big * g)

    for shock in noise:
        c = rest - (z - y)
        u = c * vz * (theta[0] + theta[1] * (target - height(z, y, vz))) + shock
        total += ((height(z, y, vz) - target) ** 2 + effort * u * u) / len(noise)
        push = k * c + b * (vy - vz) + u
        force = 0.0 if kappa else np.maximum(-stiffness * y, 0.0)
        vz, vy = vz + dt * (push / big - g), vy + dt * ((force - push) / small - g)
        if kappa:
            # (a + c force) force = kappa with the gap a of a step without contact
            a, opened = y + dt * vy, dt * dt / small
            root = np.sqrt(a * a + 4.0 * opened * kappa)
            force = np.where(a > 0, 2.0 * kappa / (np.abs(a) + root), (np.abs(a) + root) / (2.0 * opened))
            vy = vy + dt * force / small
        z, y = z + dt * vz, y + dt * vy
    return total + (height(z, y, vz) - target) ** 2


def _by_hermite(cost, theta, sigma, count):
    """Return grad J for noise on two parameters, E[f w] / sigma, by Gauss-Hermite quadrature."""
    nodes, weights = special.roots_hermitenorm(count)
    w = np.array(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    both = np.outer(weights, weights).ravel() / weights.sum() ** 2
    return (w * both) @ cost(theta[:, None] + sigma * w) / sigma


def _by_differences(cost, theta, sigma, noise):
    """Return grad J and its standard errors ``(d,)``, by central differences of theta with the same noise ``(horizon, B)``."""
    columns = []
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-4 * theta[i]
        columns.append((cost(theta + step, sigma * noise) - cost(theta - step, sigma * noise)) / (2e-4 * theta[i]))
    terms = np.array(columns)
    return terms.mean(axis=1), terms.std(axis=1, ddof=1) / math.sqrt(noise.shape[1])


def _reference(scene, contact, backend, samples):
    method = registry.make("integrators", "semi_implicit_euler", {})
    law = None if contact is None else registry.make("contacts", *contact)
    problem = registry.make("backends", backend, {}).compile(compose(registry.make("scenes", scene, {}), law, method))
    return problem, certify(problem, problem.provides, samples, 0.005)


def references():
    """Certified references of scenes without closed form, against the simulations above and the engine's own costs."""
    _, found = _reference("friction_block", ("penalty", {"stiffness": 1e5}), "fused", 1 << 14)
    own = [_by_hermite(_block, np.array([0.3, 1.0]), 0.02, count) for count in (44, 60)]
    allowed = 4 * found.known().standard_error + float(np.linalg.norm(own[0] - own[1]))
    yield _compared("friction_block, penalty", found, own[1], allowed)
    laws = {
        "penalty": (("penalty", {"stiffness": 1e4}), 0.0),
        "complementarity": (("complementarity", {"kappa": 1e-4}), 1e-4),
    }
    noise = np.random.default_rng(8).standard_normal((1000, 2000))
    for name, (law, kappa) in laws.items():
        _, found = _reference("hopper", law, "implicit" if kappa else "fused", (1 << 10) if kappa else (1 << 13))
        own_mean, error = _by_differences(
            lambda t, w, kappa=kappa: _hop(t, w, kappa), np.array([100.0, 400.0]), 1.0, noise
        )
        allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
        yield _compared(f"hopper, {name}", found, own_mean, allowed)
    try:
        problem, found = _reference("tossed_box", None, "mujoco", 1 << 11)
    except Exception as error:  # the library is not installed
        print(f"tossed_box on mujoco was not run: {error}")
        return
    # antithetic pairs of costs with a fitted line subtracted: no gradient of the backend is used
    w = np.random.default_rng(9).standard_normal((3, 4000))
    theta, sigma = problem.program.theta0, 0.1
    d = (problem.value(theta, w) - problem.value(theta, -w)) / (2 * sigma)
    line = np.linalg.lstsq(w.T, d, rcond=None)[0]
    terms = (d - line @ w) * w + line[:, None]
    error = terms.std(axis=1, ddof=1) / math.sqrt(w.shape[1])
    allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
    yield _compared("tossed_box, mujoco", found, terms.mean(axis=1), allowed)


def _compared(name, found, own, allowed):
    apart = float(np.linalg.norm(found.gradient - own))
    size = float(np.linalg.norm(own))
    stated = found.known().standard_error
    label = (
        f"{name} ({found.method}): error {apart / size:.1e} of the norm, stated {stated / size:.1e}, allowed "
        f"{allowed / size:.1e}"
    )
    return label, not apart <= allowed


def main():
    """Print a line per reference; return 1 if a difference is too large."""
    failed = False
    for line, is_wrong in references():
        failed |= is_wrong
        print(f"{line}{'  <-- wrong' if is_wrong else ''}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
