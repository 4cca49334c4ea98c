"""Means and variances of three estimators on 14 stiffnesses of `pushing`, as a user would write them: ``python validation/speed/sweep.py``.

Prints JSON: stiffness, estimator, variance, mean estimate and reference. Noise is drawn as in :mod:`bench.measure.noise`.
"""

import json
import zlib
from types import SimpleNamespace

import by_hand
import jax
import numpy as np

SCENE = SimpleNamespace(dt=0.005, mass=0.1, velocity_factor=0.6, speed=0.0, sigma=0.3)
THETA = np.full(30, 0.1)
STIFFNESSES = np.geomspace(100.0, 3000.0, 14).round().tolist()
SAMPLES, REPEATS = 256, 64
REFERENCE = {0: 4096} | {64 << i: 4096 << i for i in range(6)}
"""Samples of the reference by the seed of their generator: 262,144."""


def drawn(seed, stream, repeats, samples):
    """Return standard normal noise ``(T, repeats * samples)``."""
    names = [zlib.crc32(name.encode()) for name in (stream, "pushing")]
    keys = [np.random.SeedSequence([seed, *names, repeat]) for repeat in range(repeats)]
    draws = [np.random.Generator(np.random.Philox(key)).standard_normal((samples, THETA.size)) for key in keys]
    return np.concatenate(draws).T


def main():
    """Print a row for each stiffness and estimator."""
    jax.config.update("jax_enable_x64", True)
    cost = by_hand.jax_cost(SCENE)
    value = jax.jit(jax.vmap(cost, in_axes=(None, None, 1)))
    gradient = jax.jit(jax.vmap(jax.grad(cost, argnums=1), in_axes=(None, None, 1), out_axes=1))
    w = drawn(0, "cells", REPEATS, SAMPLES)
    far = np.concatenate([drawn(seed, "reference", 1, count) for seed, count in REFERENCE.items()], axis=1)
    parts = np.split(far, 64, axis=1)  # fit a core's cache
    rows = []
    for stiffness in STIFFNESSES:
        reference = np.mean([gradient(stiffness, THETA, part).mean(axis=1) for part in parts], axis=0)
        costs = np.asarray(value(stiffness, THETA, w)).reshape(REPEATS, SAMPLES)
        against = (costs - costs.mean(axis=1, keepdims=True)) * SAMPLES / (SAMPLES - 1)
        terms = {
            "fobg": np.asarray(gradient(stiffness, THETA, w)),
            "reinforce": against.ravel() * w / SCENE.sigma,
            "randomized_smoothing": (costs.ravel() - np.asarray(value(stiffness, THETA, -w))) * w / (2 * SCENE.sigma),
        }
        for name, each in terms.items():
            means = each.reshape(THETA.size, REPEATS, SAMPLES).mean(axis=2)
            variance = means.var(axis=1, ddof=1).sum()
            rows.append((stiffness, name, variance, means.mean(axis=1).tolist(), reference.tolist()))
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
