"""Building blocks of claims: problems from identity strings, exact and sampled moments, gradient descent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from bench.errors import Unsupported
from bench.experiment.by_name import compile_problem, make
from bench.host.identity import parse_identity
from bench.model import Answer, Array, Estimator, FunctionScene, Optimizer, Problem, SampleMean, Scene

used: set[tuple[str, str]] = set()
"""Kind and name of the plugins built since the set was cleared. The numbers of a claim depend on them."""
WIDTH = 9.0
"""Range of the quadrature rules [standard deviations]. A normal variable is outside with probability 2e-19."""


def plugin(kind: str, identity: str, defaults: Mapping[str, Any] | None = None) -> Any:
    """Return the plugin of an identity string, ``penalty[stiffness=1e4]``; ``defaults`` are a scene's own values.

    Raises :class:`Unsupported` if a library that the plugin needs is not installed.
    """
    used.add((kind, parse_identity(identity)[0]))
    return make(kind, identity, defaults)


def estimator(identity: str) -> Estimator:
    """Return an estimator by its identity string. Raises :class:`Unsupported` if a library is missing."""
    result: Estimator = plugin("estimators", identity)
    return result


def problem(
    scene: Scene | str, contact: str = "penalty", backend: str = "jax", integrator: str = "semi_implicit_euler"
) -> Problem:
    """Compile a scene, given by its identity string or as an object.

    The contact law counts if the scene has contacts, the integrator if it has motion. Raises :class:`Unsupported` for a
    combination that cannot run here.
    """
    return compile_problem(scene, contact, integrator, backend, make=plugin)


def native(scene: Scene | str, contact: str = "penalty", integrator: str = "semi_implicit_euler") -> Problem:
    """Compile a scene for thousands of small calls: as a native loop, or with JAX if the native library is missing."""
    try:
        return problem(scene, contact, "fused", integrator)
    except Unsupported:
        return problem(scene, contact, "jax", integrator)


def function(cost: Callable[[Any, Array], Array], start: Any, sigma: float, continuous: bool = True) -> FunctionScene:
    """Return the scene of a plain cost ``cost(xp, x)`` at theta ``start``, with noise on theta."""
    body = {
        "name": cost.__name__,
        "continuous": continuous,
        "__doc__": cost.__doc__,
        "theta0": lambda self: np.array(start, dtype=float),
        "cost": lambda self, xp, x: cost(xp, x),
    }
    scene: Any = dataclass(frozen=True)(type(cost.__name__, (FunctionScene,), body))
    return cast(FunctionScene, scene(sigma=sigma))


def terms(problem: Problem, estimator: Estimator, w: np.ndarray, theta: np.ndarray | float | None = None) -> np.ndarray:
    """Return single-sample estimates ``(B, d)`` at ``theta``, by default ``theta0``, for noise ``w (n_w, B)``."""
    at = problem.program.theta0 if theta is None else np.atleast_1d(theta)
    return estimator.estimate(problem, at, w.T[:, None, :])


def rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes ``(1, count)`` and weights of the midpoint rule for a standard normal variable."""
    edges = np.linspace(-WIDTH, WIDTH, count + 1)
    nodes = (edges[1:] + edges[:-1]) / 2
    weights = np.exp(-0.5 * nodes * nodes)
    return nodes[None], weights / weights.sum()


def moments(
    problem: Problem, estimator: Estimator, theta: np.ndarray | float | None = None, count: int = 400_000
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return mean and per-sample variance of an estimator with one noise variable, each with its quadrature error."""
    results = []
    for n in (count, round(0.7 * count) | 1):
        nodes, weights = rule(n)
        values = terms(problem, estimator, nodes, theta)[:, 0]
        mean = float(values @ weights)
        results.append((mean, float((values - mean) ** 2 @ weights)))
    first, second = ((value, abs(value - other)) for value, other in zip(*results, strict=True))
    return first, second


def means(problem: Problem, estimator: Estimator, thetas: Iterable[float], count: int) -> list[float]:
    """Return the means of an estimator with one noise variable at each theta, see :func:`moments`."""
    return [moments(problem, estimator, theta, count)[0][0] for theta in thetas]


def spread(values: np.ndarray, batches: int = 50) -> tuple[float, float]:
    """Return the variance of samples ``(B, d)``, summed over components, and its standard error from batches."""
    groups = np.array_split(values, batches)
    each = np.array([group.var(axis=0, ddof=1).sum() for group in groups])
    return float(values.var(axis=0, ddof=1).sum()), float(each.std(ddof=1) / np.sqrt(batches))


def centre(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of samples ``(B,)`` and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def descend(
    step: Callable[[np.ndarray, int], np.ndarray], start: np.ndarray, rate: float, iterations: int
) -> np.ndarray:
    """Return the path ``(iterations + 1, ...)`` of the optimizer ``gradient_descent``; ``step(theta, i)`` is the gradient."""
    optimizer: Optimizer = plugin("optimizers", f"gradient_descent[rate={rate!r}]")
    path, state = [np.array(start, dtype=float)], optimizer.start(np.ravel(start))
    for i in range(iterations):
        gradient = np.asarray(step(path[-1], i), dtype=float).reshape(-1, 1)
        state = optimizer.tell(state, path[-1].reshape(-1, 1), Answer(gradient=gradient))
        path.append(state["theta"].reshape(path[-1].shape))
    return np.array(path)


def exact_descent(
    problem: Problem, start: np.ndarray, rate: float, iterations: int, every: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the last point ``(d,)`` of descent on the gradient without noise, and the cost of every so many steps."""
    still = np.zeros((problem.program.n_noise, 1))
    path = descend(lambda theta, _: problem.grad(theta, still)[:, 0], start, rate, iterations)
    points = path[::every].T
    return path[-1], problem.value(points, np.repeat(still, points.shape[1], axis=1))


def stochastic_descent(problem: Problem, zeroth: bool, rate: float, iterations: int, seed: int) -> np.ndarray:
    """Descend on one variable from 0.1 in 20 independent runs. Returns their last points ``(20,)``.

    A step uses the mean of 50 terms of ``fobg`` or, with ``zeroth``, of ``reinforce[baseline=center]``.
    """
    runs, samples = 20, 50
    noise = np.random.default_rng(seed).standard_normal((iterations, 1, runs * samples))
    method = estimator("reinforce[baseline=center]" if zeroth else "fobg")
    assert isinstance(method, SampleMean)

    def step(theta: np.ndarray, i: int) -> np.ndarray:
        if not zeroth:
            # one theta per column
            values = method.terms(problem, np.repeat(theta, samples)[None], noise[i])[0]
        else:
            parts = np.split(noise[i], runs, axis=1)
            values = np.concatenate([method.terms(problem, at[None], w)[0] for at, w in zip(theta, parts, strict=True)])
        return np.asarray(values.reshape(runs, samples).mean(axis=1))

    ends: np.ndarray = descend(step, np.full(runs, 0.1), rate, iterations)[-1]
    return ends
