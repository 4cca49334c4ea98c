"""What claims are made of: problems from plugin names or scenes of their own, exact and sampled moments, descents."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.errors import Unsupported
from bench.model import Estimator, MechanicalScene, Plugin, Problem, Scene, compose, registry
from bench.model.identity import parse_identity
from bench.model.parameters import build, parameters

used: set[tuple[str, str]] = set()
"""Kind and name of the plugins made since the set was cleared: what the numbers of a claim rest on."""
WIDTH = 9.0
"""Standard deviations to which the rules below reach: 2e-19 of a normal variable lies outside."""


def plugin_class(kind: str, name: str) -> type[Any]:
    """Return a plugin class by its name; raises :class:`Unsupported` where its library is missing."""
    used.add((kind, name))
    entry = registry.find(kind, name)
    if not entry.available:
        raise Unsupported(f"{kind} {name} is {entry.reason}")
    return registry.usable(kind, name)


def plugin(kind: str, identity: str, given: Any = None) -> Any:
    """Return a plugin by its identity string, ``penalty[stiffness=1e4]``, over the values ``given`` by a scene."""
    name, values = parse_identity(identity)
    cls = plugin_class(kind, name)
    declared = parameters(cls)
    return build(cls, {k: v for k, v in (given or {}).items() if k in declared} | values)


def estimator(identity: str) -> Estimator:
    """Return an estimator by its identity string."""
    made: Estimator = plugin("estimators", identity)
    return made


def problem(
    scene: Scene | str, contact: str = "penalty", backend: str = "jax", integrator: str = "semi_implicit_euler"
) -> Problem:
    """Compile a scene, given by name or itself, under a contact law and an integrator where it has them."""
    chosen: Scene = plugin("scenes", scene) if isinstance(scene, str) else scene
    law: Plugin | None = None
    step: Plugin | None = None
    if isinstance(chosen, MechanicalScene):
        law = plugin("contacts", contact, chosen.contact_values) if chosen.n_contacts else None
        step = plugin("integrators", integrator)
    program = compose(chosen, law, step)  # type: ignore[arg-type]
    engine = plugin("backends", backend)
    if reason := engine.incompatibility(program):
        raise Unsupported(reason)
    compiled: Problem = engine.compile(program)
    return compiled


def native(scene: Scene | str, contact: str = "penalty") -> Problem:
    """Compile a scene as a native loop, or with JAX where that library is missing: for thousands of small calls."""
    try:
        return problem(scene, contact, backend="fused")
    except Unsupported:
        return problem(scene, contact)


def terms(problem: Problem, estimator: Estimator, w: np.ndarray, theta: np.ndarray | None = None) -> np.ndarray:
    """Return the estimates of one sample each, ``(B, d)``, for noise ``w (n_w, B)``."""
    at = problem.program.theta0 if theta is None else np.atleast_1d(theta)
    return estimator.estimate(problem, at, w.T[:, None, :])


def rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes ``(1, count)`` and weights of the midpoint rule for a standard normal variable."""
    edges = np.linspace(-WIDTH, WIDTH, count + 1)
    nodes = (edges[1:] + edges[:-1]) / 2
    weights = np.exp(-0.5 * nodes * nodes)
    return nodes[None], weights / weights.sum()


def hermite(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights that are exact for polynomials of a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return nodes[None], weights / weights.sum()


def expectation(function: Callable[[np.ndarray], np.ndarray], count: int = 400_000) -> tuple[float, float]:
    """Return E function(w) of one standard normal variable, and the change against a rule of other nodes.

    ``function`` maps ``(1, B)`` to ``(B,)`` and may jump: the error then is about a node's share of the jump.
    """
    values = []
    for n in (count, round(0.7 * count) | 1):
        nodes, weights = rule(n)
        values.append(float(function(nodes) @ weights))
    return values[0], abs(values[0] - values[1])


def moments(
    problem: Problem, estimator: Estimator, theta: np.ndarray | float | None = None, count: int = 400_000
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return mean and per-sample variance of an estimator with one noise number, each with its error."""
    at = problem.program.theta0 if theta is None else np.atleast_1d(np.asarray(theta, dtype=float))
    found = []
    for n in (count, round(0.7 * count) | 1):
        nodes, weights = rule(n)
        values = terms(problem, estimator, nodes, at)[:, 0]
        mean = float(values @ weights)
        found.append((mean, float((values - mean) ** 2 @ weights)))
    (mean, variance), (other_mean, other_variance) = found
    return (mean, abs(mean - other_mean)), (variance, abs(variance - other_variance))


def spread(values: np.ndarray, batches: int = 50) -> tuple[float, float]:
    """Return the variance (trace) of samples ``(B, d)`` and its standard error from batches."""
    groups = np.array_split(values, batches)
    each = np.array([group.var(axis=0, ddof=1).sum() for group in groups])
    return float(values.var(axis=0, ddof=1).sum()), float(each.std(ddof=1) / np.sqrt(batches))


def centre(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of samples ``(B,)`` and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def descend(
    step: Callable[[np.ndarray, int], np.ndarray], start: np.ndarray, rate: float, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return where gradient descent ends, and the path ``(iterations + 1, ...)``; ``step(theta, i)`` is the gradient."""
    theta = np.array(start, dtype=float)
    path = [theta.copy()]
    for i in range(iterations):
        theta = theta - rate * step(theta, i)
        path.append(theta.copy())
    return theta, np.array(path)


def stochastic_descent(
    problem: Problem,
    zeroth: bool,
    start: float,
    rate: float,
    iterations: int,
    seed: int,
    runs: int = 20,
    samples: int = 50,
) -> tuple[np.ndarray, np.ndarray]:
    """Descend on one variable, ``runs`` times beside each other; returns the ends ``(runs,)`` and the paths.

    A step takes the mean of ``samples`` gradients or, with ``zeroth``, of (f - f at w = 0) w / sigma.
    """
    noise = np.random.default_rng(seed).standard_normal((iterations, 1, runs * samples))

    def step(theta: np.ndarray, i: int) -> np.ndarray:
        every, w = np.repeat(theta, samples)[None], noise[i]
        if zeroth:
            base = problem.value(theta[None], np.zeros((1, runs)))
            values = (problem.value(every, w) - np.repeat(base, samples)) * w[0] / problem.sigma
        else:
            values = problem.grad(every, w)[0]
        return values.reshape(runs, samples).mean(axis=1)

    return descend(step, np.full(runs, start), rate, iterations)
