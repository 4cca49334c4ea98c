"""Planted faults of torch and JAX simulators, and correct gradients, which `tests/examine/test_bank.py` examines.

Failures of engines by their mechanisms are in `mechanisms.py`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Case:
    """A cost with a gradient, and the expected result of an examination."""

    name: str
    cost: Callable[..., Any]
    theta: Any
    grad: Any
    causes: tuple[str, ...] = ()
    """Correct names of the planted fault, ``refused`` if JAX has no gradient; empty for a correct gradient."""
    settings: dict[str, Any] = field(default_factory=dict)


# ------------------------------------------------------------------------------------------------ NumPy


def complex_step(cost, *extra):
    """Return a function for the gradient of an analytic cost, exact up to rounding (Squire and Trapp 1998)."""

    def gradient(x, *w):
        steps = np.array(x, dtype=complex)[None] + 1e-30j * np.eye(len(x))
        return np.array([cost(row, *w).imag for row in steps]) / 1e-30

    return gradient


def swing(x, steps=100, dt=0.02):
    """Return q^2 + 0.1 v^2 at the end of a damped pendulum's motion; theta is first angle, first speed and damping."""
    q, v = x[0], x[1]
    for _ in range(steps):
        v = v + dt * (-9.81 * np.sin(q) - x[2] * v)
        q = q + dt * v
    return q * q + 0.1 * v * v


def landing(x, steps=150, dt=2e-3, slope=False):
    """Return the cost of a ball on a damped spring floor or, with ``slope``, its derivative by height and speed."""
    q, v, dq, dv = x[0], x[1], np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for _ in range(steps):
        depth = max(-q, 0.0)
        force = -9.81 + 2e3 * depth - 50.0 * depth * v
        dforce = float(q < 0) * (-2e3 * dq + 50.0 * v * dq - 50.0 * depth * dv)
        v, dv = v + dt * force, dv + dt * dforce
        q, dq = q + dt * v, dq + dt * dv
    return 2 * (q - 0.2) * dq if slope else (q - 0.2) ** 2


def fixed_point(x, tolerance=1e-7, slope=False):
    """Return z^2 for z = cos(z) x0 x1 / 3, iterated until z moves at most ``tolerance``, or its implicit derivative."""
    z, before, c = 0.0, 1.0, x[0] * x[1] / 3
    while abs(z - before) > tolerance:
        z, before = np.cos(z) * c, z
    return 2 * z * np.cos(z) / 3 * np.array([x[1], x[0]]) / (1 + np.sin(z) * c) if slope else z * z


START = [0.4, 0.3, 0.5]


def friction(x, steps=60, dt=0.01):
    """Return the cost of a block pushed over a floor whose friction changes sign within 1 mm/s, so that it is stiff."""
    q, v = 0.0, x[0]
    for t in range(steps):
        v = v + dt * (x[1] * (t < steps // 2) - np.tanh(v / 1e-3))
        q = q + dt * v
    return q * q


def decay(x, steps=20, dt=0.1):
    """Return the cost of implicit Euler steps of y' = -k (y - cos y), k = x1; each step is a Newton solve to rounding."""
    y = x[0]
    for _ in range(steps):
        z = y
        for _ in range(8):
            z = z - (z - y + dt * x[1] * (z - np.cos(z))) / (1 + dt * x[1] * (1 + np.sin(z)))
        y = z
    return y * y + 1e-3 * np.sin(x[0]) * y + 1e-7 * x[1]


def lorenz(x, steps=150, dt=0.01):
    """Return the cost of Lorenz's equations by Euler's method; theta is the initial state."""
    a, b, c = x[0], x[1], x[2]
    for _ in range(steps):
        a, b, c = a + dt * 10 * (b - a), b + dt * (a * (28 - c) - b), c + dt * (a * b - 8 / 3 * c)
    return a * a + c


def bounces(x):
    """Return the final height of a ball that bounces twice, with exact times of impact.

    theta is height and upward speed. The height has a kink where the number of bounces changes.
    """
    state, left = (x[0], x[1]), 1.0
    while True:
        hit = (state[1] + np.sqrt(state[1] ** 2 + 2 * 9.81 * state[0])) / 9.81
        if hit.real > left:
            return state[0] + state[1] * left - 9.81 / 2 * left**2
        state, left = (0.0, 0.8 * (9.81 * hit - state[1])), left - hit


def network(x, slope=False):
    """Return the cost of a network of rectifiers, which has kinks near theta but not at it, or its derivative."""
    first = np.outer(np.arange(1, 9) / 8, [1.0, -2.0, 0.7]) + np.sin(np.arange(24).reshape(8, 3))
    inside = first @ np.array(x) + np.cos(np.arange(8))
    out = np.maximum(inside, 0) @ np.cos(np.arange(8))
    return 2 * out * ((inside > 0) * np.cos(np.arange(8))) @ first if slope else out**2


def right_cases():
    """Yield correct gradients: stiff, chaotic and with kinks."""
    right, start = complex_step(swing), np.array(START)

    def driven(x, w):
        q, v = x[0], x[1]
        for push in w:
            v = v + 0.05 * (-9.81 * np.sin(q) - x[2] * v + push)
            q = q + 0.05 * v
        return q * q

    yield Case("pendulum", swing, START, right)
    yield Case("contact", landing, [0.1, -0.5], lambda x: landing(x, slope=True))
    yield Case("cost of 1e-12", lambda x: 1e-12 * swing(x), START, lambda x: 1e-12 * right(x))
    yield Case("solver to 1e-7", fixed_point, [1.0, 2.0], lambda x: fixed_point(x, slope=True))
    yield Case("own noise", driven, START, complex_step(driven), settings={"noise": 20})
    yield Case("friction within 1 mm/s", friction, [0.8, 3.0], complex_step(friction))
    yield Case("implicit, k = 1e6", decay, [0.4, 1e6], complex_step(decay))
    yield Case("Lorenz", lorenz, [1.0, 2.0, 20.0], complex_step(lorenz))
    yield Case("two bounces", bounces, [0.7, 0.4], complex_step(bounces))
    yield Case("rectifiers", network, START, lambda x: network(x, slope=True))
    yield Case(
        "at a minimum",
        lambda x: np.sum((x - start) ** 4 + (x - start) ** 2),
        START,
        lambda x: 4 * (x - start) ** 3 + 2 * (x - start),
    )
    yield Case(
        "at the origin",
        lambda x: np.expm1(x[0]) - np.sin(x[1]) * 1e-6,
        [0.0, 0.0],
        lambda x: [np.exp(x[0]), -np.cos(x[1]) * 1e-6],
    )
    yield Case(
        "steep wall",
        lambda x: np.log1p(np.exp(300 * (x[0] - x[1]))) / 300 + x[0] ** 2,
        [0.4, 0.38],
        lambda x: np.array([1.0, -1.0]) / (1 + np.exp(-300 * (x[0] - x[1]))) + [2 * x[0], 0.0],
    )


# ------------------------------------------------------------------------------------------------ torch


def fall(x, cut=lambda f: f, state=lambda q: q, steps=35, stiffness=200.0):
    """Return the cost of a ball on a damped spring floor; theta is height and upward speed, and ``cut`` is of the floor's force."""
    q, v = x[0], x[1]
    for _ in range(steps):
        depth = (-q).relu()
        v = v + 0.01 * (cut(stiffness * depth - 3.0 * depth * v) - 9.81)
        q = state(q + 0.01 * v)
    return (q - 0.2) ** 2 + 0.1 * v * v


def torch_cases():
    import torch

    def clamped(q):
        q = q.clone()
        q.data.clamp_(max=0.03)
        return q

    class Halved(torch.autograd.Function):
        @staticmethod
        def forward(context, x):
            context.save_for_backward(x)
            return x.sin()

        @staticmethod
        def backward(context, slope):
            return 0.5 * slope * context.saved_tensors[0].cos()

    def ranked(x):
        return (x * torch.argsort(x).double()).sum() + torch.sort(x).indices.double()[0]

    at, cut, off = [0.05, -0.4], ("missing_term",), ("disconnected",)
    yield Case("detach on the force", lambda x: fall(x, lambda f: f.detach()), at, "torch", cut)
    yield Case("item() in the loop", lambda x: fall(x, state=lambda q: q * 0 + q.item()), at, "torch", off)
    yield Case("in-place clamp of data", lambda x: fall(x, state=clamped), at, "torch", cut)
    yield Case("rounded", lambda x: fall((x * 1e5).long() / 1e5), at, "torch", ("staircase",))
    yield Case("rank by sorting", ranked, [0.3, 0.3], "torch", ("jump",))
    yield Case("wrong backward", lambda x: Halved.apply(x).sum(), [0.3, 0.7], "torch", ("wrong_factor",))

    three = [0.3, -0.7, 0.2]
    yield Case("ball on a floor", fall, at, "torch")
    yield Case("small network", lambda x: torch.tanh(torch.outer(x, x) @ x).sum(), three, "torch")
    yield Case("sorted values", lambda x: (torch.sort(x).values * torch.arange(3)).sum(), three, "torch")


# -------------------------------------------------------------------------------------------------- JAX


def jax_cases():
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def push(x, cut=lambda f: f, steps=80):
        def step(carry, _):
            q, v = carry
            gap = q[1] - q[0]
            force = cut(100.0 * jax.nn.softplus(-20.0 * gap) / 20.0)
            v = v + 0.02 * jnp.stack([-force, force])
            return (q + 0.02 * v, v), None

        (q, v), _ = jax.lax.scan(step, (jnp.array([0.0, 0.2]), x), None, length=steps)
        return (q[1] - 1.0) ** 2 + 0.1 * v @ v

    @jax.custom_vjp
    def wrong(x):
        return jnp.sin(x)

    wrong.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (-g * jnp.cos(x),))

    at = [1.0, 0.1]
    yield Case("stop_gradient on contact", lambda x: push(x, jax.lax.stop_gradient), at, "jax", ("missing_term",))
    yield Case("stop_gradient on theta", lambda x: push(jax.lax.stop_gradient(x)), at, "jax", ("disconnected",))
    yield Case("wrong custom_vjp", lambda x: wrong(x).sum(), at, "jax", ("wrong_factor",))
    yield Case("float(x) in the loop", lambda x: push(x) + float(x[0]), at, "jax", ("refused",))

    yield Case("pushing", push, at, "jax")
    yield Case("stiff, implicit", lambda x: jnp.sum((x / 1001.0) ** 2) * 1e6 + jnp.sum(x), at, "jax")
    yield Case("kink beside theta", lambda x: jnp.sum(jnp.abs(x - 0.1003) * x), at, "jax")


CASES = {"torch": torch_cases, "jax": jax_cases}


def examined(case):
    """Return the report on a case."""
    from bench.examine.examination import examine

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return examine(case.cost, case.theta, grad=case.grad, progress=False, budget=60, **case.settings)
