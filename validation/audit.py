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


def _hop(theta, noise):
    """Return the costs ``(B,)`` of a hopper with forces ``noise (horizon, B)``, on a spring."""
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
        force = np.maximum(-stiffness * y, 0.0)
        vz, vy = vz + dt * (push / big - g), vy + dt * ((force - push) / small - g)
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
    program = compose(registry.make("scenes", scene, {}), registry.make("contacts", *contact), method)
    problem = registry.make("backends", backend, {}).compile(program)
    return certify(problem, problem.provides, samples, 0.005)


def references():
    """Certified references of scenes without closed form, against the simulations above."""
    found = _reference("friction_block", ("penalty", {"stiffness": 1e5}), "fused", 1 << 14)
    own = [_by_hermite(_block, np.array([0.3, 1.0]), 0.02, count) for count in (44, 60)]
    allowed = 4 * found.known().standard_error + float(np.linalg.norm(own[0] - own[1]))
    yield _compared("friction_block, penalty", found, own[1], allowed)
    found = _reference("hopper", ("penalty", {"stiffness": 1e4}), "fused", 1 << 13)
    noise = np.random.default_rng(8).standard_normal((1000, 2000))
    own_mean, error = _by_differences(_hop, np.array([100.0, 400.0]), 1.0, noise)
    allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
    yield _compared("hopper, penalty", found, own_mean, allowed)


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
