"""Measures intervals and references with a second implementation: `python validation/audit.py [SETS [SECTION]]`.

The true values come from closed forms, or from code below that imports no statistics, scene or contact law of this package.
Coverage is the share of SETS simulated data sets whose 95% interval contains the true value, without leaving out any set.
Sections: tails, references.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
from scipy import special

Line = tuple[str, bool]
"""What was measured with its value, and whether that is wrong."""


def within(interval: tuple[float, float], truth: float) -> bool:
    return bool(interval[0] <= truth <= interval[1])


# ---------------------------------------------------------------------------------- estimators (bias_variance)


def tails(sets: int) -> Iterator[Line]:
    """Intervals of some estimators of exp(x) and of a hinge that 1 sample in 160 meets, and of every one on a sum of sines.

    Many estimates give the true bias, variance and RMSE.
    """
    import bank
    from bench.plugins.backends.numpy import Numpy

    from bench.measure.statistics import Truth, summarise
    from bench.model import SampleMean, columns, compose, per_repeat, registry
    from bench.report.views import rmse_interval
    from bench.studies.bias_variance.measure import summarise_diagnostics

    few: list[tuple[str, dict[str, str]]] = [
        ("fobg", {}), ("reinforce", {}), ("reinforce", {"baseline": "leave_one_out"}), ("control_variate", {}),
        ("randomized_smoothing", {}), ("randomized_smoothing", {"variant": "forward"}),
    ]  # fmt: skip
    every: list[tuple[str, dict[str, str]]] = [(name, {}) for name in sorted(registry.entries()["estimators"])]
    one = [np.ones(1)], np.zeros(1), 1.0
    for label, scene, samples, estimators in (
        ("exp(x)", bank.Ridge([bank.growth(1.0)], *one), 16, few),
        ("hinge", bank.Ridge([bank.ramp(2.5, 20.0)], *one), 16, few),
        ("sines", bank.Ridge([bank.wave(1.0)] * 3, list(np.eye(3)), np.full(3, 0.3), 0.2), 32, every),
    ):
        problem, theta, truth = Numpy().compile(compose(scene)), scene.start, Truth.exact(scene.truth())
        for name, values in estimators:
            method = registry.make("estimators", name, values)
            if refused := method.incompatibility(problem.program, problem.provides, "numpy"):
                print(f"{label}: {refused}")
                continue
            random = np.random.default_rng(10)
            size = 2000, samples, theta.size
            many = np.concatenate(
                [method.estimate(problem, theta, random.standard_normal(size)) for _ in range(960 // samples)]
            )
            bias = (
                float(np.linalg.norm(many.mean(axis=0) - truth.mean))
                if not method.declares_unbiased(problem.program)
                else 0.0
            )
            variance = float(many.var(axis=0).sum())
            for repeats in (16, 64):
                inside = []
                for _ in range(sets):
                    noise = random.standard_normal((repeats, samples, theta.size))
                    sums = None
                    if isinstance(method, SampleMean) and method.separable:
                        terms = per_repeat(method.terms(problem, theta, columns(noise)), noise)
                        terms = terms - terms[0].mean(axis=0)
                        sums = terms.sum(axis=1), np.einsum("rnd,rnd->r", terms, terms)
                    estimates, diagnostics = method.estimate_with_diagnostics(problem, theta, noise)
                    found = summarise(estimates, truth, samples, sums)
                    doubt = method.remark(json.loads(summarise_diagnostics([diagnostics]))) if diagnostics else ""
                    inside.append((
                        within((found.bias_low, found.bias_high), bias),
                        within((found.variance_low, found.variance_high), variance),
                        within((found.variance_per_sample_low, found.variance_per_sample_high), variance * samples),
                        within(rmse_interval(pd.Series(found.__dict__)), math.sqrt(variance + bias**2) / truth.norm),
                        not (found.note or doubt),
                    ))  # fmt: skip
                held = np.array(inside)
                plain = held[held[:, -1]]
                kind = f"{label}, {', '.join([name, *values.values()])}, R = {repeats}, {1 - len(plain) / sets:.0%} with a remark"
                for place, what in enumerate(("bias", "variance", "variance per sample", "RMSE")):
                    without = f", without {plain[:, place].mean():.1%}" if len(plain) else ""
                    yield f"{what}, {kind}{without}: {held[:, place].mean():.1%}", False


# --------------------------------------------------------------------------------------------------- references


def _block(theta: np.ndarray) -> np.ndarray:
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


def _hop(theta: np.ndarray, noise: np.ndarray, kappa: float = 0.0) -> np.ndarray:
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


def _by_hermite(cost: Callable, theta: np.ndarray, sigma: float, count: int) -> np.ndarray:
    """Return grad J for noise on two parameters, E[f w] / sigma, by Gauss-Hermite quadrature."""
    nodes, weights = special.roots_hermitenorm(count)
    w = np.array(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    both = np.outer(weights, weights).ravel() / weights.sum() ** 2
    return (w * both) @ cost(theta[:, None] + sigma * w) / sigma


def _by_differences(
    cost: Callable, theta: np.ndarray, sigma: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return grad J and its standard errors ``(d,)``, by central differences of theta with the same noise ``(horizon, B)``."""
    columns = []
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-4 * theta[i]
        columns.append((cost(theta + step, sigma * noise) - cost(theta - step, sigma * noise)) / (2e-4 * theta[i]))
    terms = np.array(columns)
    return terms.mean(axis=1), terms.std(axis=1, ddof=1) / math.sqrt(noise.shape[1])


def _reference(scene, contact, backend: str, samples: int):
    from bench.measure.reference import certify
    from bench.model import compose, registry

    method = registry.make("integrators", "semi_implicit_euler", {})
    law = None if contact is None else registry.make("contacts", *contact)
    problem = registry.make("backends", backend, {}).compile(compose(registry.make("scenes", scene, {}), law, method))
    return problem, certify(problem, problem.provides, samples, 0.005)


def references(sets: int) -> Iterator[Line]:
    """Certified references of scenes without closed form, against the simulations above and the engine's own costs."""
    _, found = _reference("friction_block", ("penalty", {"stiffness": 1e5}), "fused", 1 << 14)
    own = [_by_hermite(_block, np.array([0.3, 1.0]), 0.02, count) for count in (44, 60)]
    allowed = 4 * found.known().standard_error + float(np.linalg.norm(own[0] - own[1]))
    yield _compared("friction_block, penalty", found, own[1], allowed)
    laws = {
        "penalty": (("penalty", {"stiffness": 1e4}), 0.0),
        "complementarity": (("complementarity", {"kappa": 1e-4}), 1e-4),
    }
    noise = np.random.default_rng(8).standard_normal((1000, max(400, 10 * sets)))
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
    w = np.random.default_rng(9).standard_normal((3, 20 * sets))
    theta, sigma = problem.program.theta0, 0.1
    d = (problem.value(theta, w) - problem.value(theta, -w)) / (2 * sigma)
    line = np.linalg.lstsq(w.T, d, rcond=None)[0]
    terms = (d - line @ w) * w + line[:, None]
    error = terms.std(axis=1, ddof=1) / math.sqrt(w.shape[1])
    allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
    yield _compared("tossed_box, mujoco", found, terms.mean(axis=1), allowed)


def _compared(name: str, found, own: np.ndarray, allowed: float) -> Line:
    apart = float(np.linalg.norm(found.gradient - own))
    size = float(np.linalg.norm(own))
    stated = found.known().standard_error
    label = (
        f"{name} ({found.method}): error {apart / size:.1e} of the norm, stated {stated / size:.1e}, allowed "
        f"{allowed / size:.1e}"
    )
    return label, not apart <= allowed


SECTIONS = (tails, references)


def main(sets: int = 200, *sections: str) -> int:
    """Print a line per figure; return 1 if a difference is too large."""
    failed = False
    for section in SECTIONS:
        if sections and section.__name__ not in sections:
            continue
        for line, is_wrong in section(sets):
            failed |= is_wrong
            print(f"{section.__name__:10} {line}{'  <-- wrong' if is_wrong else ''}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2]), *sys.argv[2:]))
