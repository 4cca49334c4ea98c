"""Runs `bench.examine` on planted faults and correct gradients in NumPy, torch and JAX simulators, and prints a table.

    python validation/simulators.py [numpy] [right] [torch] [jax] [engines]

    python validation/simulators.py slowed [numpy] [right] [engines]

The first prints a line per case: the cause that `bench.examine` reports, its exit status, calls and seconds. `checkers.py` runs other
gradient checkers on the same cases. The second compares each verdict with that of a cost that is four times slower.
"""

from __future__ import annotations

import functools
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Case:
    """A cost with a gradient, and the expected result of an examination."""

    name: str
    library: str
    cost: Callable[..., Any]
    theta: Any
    grad: Any
    causes: tuple[str, ...] = ()
    """Correct names of the planted fault; empty for a correct gradient."""
    settings: dict[str, Any] = field(default_factory=dict)
    warned: str = ""
    """Expected start of a warning about a correct gradient."""


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


def landing(x, damper=True, contact=True, steps=150, dt=2e-3, slope=False):
    """Return the cost of a ball on a spring floor or, with ``slope``, its derivative by height and speed.

    The floor's damper acts on the way in and out. The derivative omits the damper's term in speed unless ``damper``, and
    all contact terms unless ``contact``.
    """
    q, v, dq, dv = x[0], x[1], np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for _ in range(steps):
        depth = max(-q, 0.0)
        inside = float(q < 0)
        force = -9.81 + 2e3 * depth - 50.0 * depth * v
        dforce = inside * contact * (-2e3 * dq + 50.0 * v * dq - damper * 50.0 * depth * dv)
        v, dv = v + dt * force, dv + dt * dforce
        q, dq = q + dt * v, dq + dt * dv
    return 2 * (q - 0.2) * dq if slope else (q - 0.2) ** 2


def bisected(x, tolerance, slope=False):
    """Return the square of the root z of z + z^3 = x0 x1, by bisection to ``tolerance``, or its implicit derivative."""
    low, high = -10.0, 10.0
    while high - low > tolerance:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if middle + middle**3 < x[0] * x[1] else (low, middle)
    z = 0.5 * (low + high)
    return np.array([x[1], x[0]]) / (1 + 3 * z * z) * 2 * z if slope else z * z


def fixed_point(x, tolerance=1e-7, slope=False):
    """Return z^2 for z = cos(z) x0 x1 / 3, iterated until z moves at most ``tolerance``, or its implicit derivative."""
    z, before, c = 0.0, 1.0, x[0] * x[1] / 3
    while abs(z - before) > tolerance:
        z, before = np.cos(z) * c, z
    return 2 * z * np.cos(z) / 3 * np.array([x[1], x[0]]) / (1 + np.sin(z) * c) if slope else z * z


MIX = np.array([[2.0, 1.0, 0.3], [0.2, 1.5, -0.4], [0.1, 0.7, 1.2]])
START = [0.4, 0.3, 0.5]


def mixed(x):
    return np.sum(np.tanh(MIX @ x) ** 2)


def transposed(x):
    y = np.tanh(MIX @ x)
    return MIX @ (2 * y * (1 - y * y))


def numpy_cases():
    right = complex_step(swing)
    first = {}

    def stale(x):
        return first.setdefault("gradient", right(x))

    calls = {"count": 0}

    def counting(x):
        calls["count"] += 1
        return swing(x) + 1e-5 * calls["count"]

    fresh = np.random.default_rng(0)

    def driven(x, w):
        q, v = x[0], x[1]
        for push in w:
            v = v + 0.05 * (-9.81 * np.sin(q) - x[2] * v + push)
            q = q + 0.05 * v
        return q * q

    yield Case("factor 2", "numpy", swing, START, lambda x: 2 * right(x), ("wrong_factor",))
    yield Case("sign", "numpy", swing, START, lambda x: -right(x), ("wrong_factor",))
    yield Case("3% off", "numpy", swing, START, lambda x: 1.03 * right(x), ("wrong_factor",))
    yield Case("sign of one component", "numpy", swing, START, lambda x: right(x) * [1, 1, -1], ("wrong_factor",))
    yield Case("transposed matrix", "numpy", mixed, START, transposed, ("missing_term",))
    yield Case("components exchanged", "numpy", swing, START, lambda x: right(x)[[1, 0, 2]], ("missing_term",))
    yield Case(
        "missing contact term", "numpy", landing, [0.1, -0.5], lambda x: landing(x, contact=False, slope=True),
        ("missing_term",),
    )  # fmt: skip
    yield Case(
        "missing damper",
        "numpy",
        landing,
        [0.1, -0.5],
        lambda x: landing(x, damper=False, slope=True),
        ("missing_term",),
    )
    yield Case("last step forgotten", "numpy", swing, START, complex_step(lambda x: swing(x, 99)), ("missing_term",))
    yield Case("stale cache", "numpy", swing, START, stale, ("stale_gradient",))
    yield Case(
        "float32 inside", "numpy", lambda x: swing(np.asarray(x, np.float32)).item(), START, right, warned="precision"
    )
    yield Case(
        "cast to int",
        "numpy",
        lambda x: swing(np.floor(np.array(x) * 1e4) / 1e4),
        START,
        right,
        ("staircase", "precision"),
    )
    yield Case("state outlasts a call", "numpy", counting, START, right, ("nondeterministic",))
    yield Case(
        "noise drawn anew",
        "numpy",
        lambda x: swing(x) + 1e-7 * fresh.standard_normal(),
        START,
        right,
        ("nondeterministic",),
    )
    yield Case(
        "noise reused shifted", "numpy", driven, START, lambda x, w: complex_step(driven)(x, w[::-1]),
        ("missing_term",), {"noise": 20},
    )  # fmt: skip
    yield Case("gradient elsewhere", "numpy", swing, START, lambda x: right(np.array(x) + 0.01), ("missing_term",))
    yield Case("jump at theta", "numpy", lambda x: swing(x) + (x[0] > 0.4 - 1e-12) * 1.0, START, right, ("jump",))

    yield Case(
        "bisection to 1e-7", "numpy", lambda x: bisected(x, 1e-7), [1.0, 2.0], lambda x: bisected(x, 1e-7, slope=True),
        ("precision",),
    )  # fmt: skip
    yield Case("pendulum", "numpy", swing, START, right)
    yield Case("contact", "numpy", landing, [0.1, -0.5], lambda x: landing(x, slope=True))
    yield Case(
        "drag 2e4 beside 1", "numpy", lambda x: swing([x[0], x[1], x[2] / 4e4]), [0.4, 0.3, 2e4],
        complex_step(lambda x: swing([x[0], x[1], x[2] / 4e4])),
    )  # fmt: skip
    yield Case("cost of 1e-12", "numpy", lambda x: 1e-12 * swing(x), START, lambda x: 1e-12 * right(x))
    yield Case("cost beside 1e6", "numpy", lambda x: 1e6 + swing(x), START, right)
    yield Case("solver to 1e-7", "numpy", lambda x: fixed_point(x), [1.0, 2.0], lambda x: fixed_point(x, slope=True))
    yield Case(
        "solver to 1e-13", "numpy", lambda x: bisected(x, 1e-13), [1.0, 2.0], lambda x: bisected(x, 1e-13, slope=True)
    )
    yield Case("chaotic", "numpy", logistic, [0.3, 3.9], complex_step(logistic))
    yield Case("own noise", "numpy", driven, START, complex_step(driven), settings={"noise": 20})


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


def conjugate(x, tolerance=1e-7, slope=False):
    """Return |A(x)^-1 b|^2 by conjugate gradients to ``tolerance``, or its adjoint derivative with the same tolerance."""

    def solve(matrix, right):
        z, rest = np.zeros(3), right.copy()
        way, size = rest, rest @ rest
        while np.sqrt(size) > tolerance:
            moved = matrix @ way
            step = size / (way @ moved)
            z, rest = z + step * way, rest - step * moved
            way, size = rest + rest @ rest / size * way, rest @ rest
        return z

    matrix, b = MIX @ MIX.T + np.diag(np.array(x) ** 2), np.array([1.0, -2.0, 0.5])
    z = solve(matrix, b)
    if not slope:
        return z @ z
    return -solve(matrix, 2 * z) * 2 * np.array(x) * z


def bounces(x, slope=False):
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
    """Yield more correct gradients: stiff, chaotic, with kinks, from loose solvers, and of very different sizes."""
    spread = np.array([1e-6, 1e6, 1.0])
    many = np.linspace(-3, 3, 40)
    yield Case("friction within 1 mm/s", "numpy", friction, [0.8, 3.0], complex_step(friction))
    yield Case("implicit, k = 1e6", "numpy", decay, [0.4, 1e6], complex_step(decay))
    yield Case("Lorenz", "numpy", lorenz, [1.0, 2.0, 20.0], complex_step(lorenz))
    yield Case(
        "conjugate gradients to 1e-7", "numpy", conjugate, START, lambda x: conjugate(x, slope=True)
    )  # fmt: skip
    yield Case("two bounces", "numpy", bounces, [0.7, 0.4], complex_step(bounces))
    yield Case("rectifiers", "numpy", network, START, lambda x: network(x, slope=True))
    yield Case(
        "1e-6 beside 1e6", "numpy", lambda x: swing(x / spread), np.array(START) * spread,
        lambda x: complex_step(swing)(x / spread) / spread,
    )  # fmt: skip
    yield Case(
        "40 inputs", "numpy", lambda x: np.sin(x @ many) + x @ x, many / 7, lambda x: np.cos(x @ many) * many + 2 * x
    )
    yield Case("at a minimum", "numpy", lambda x: np.sum((x - np.array(START)) ** 4 + (x - np.array(START)) ** 2),
        START, lambda x: 4 * (x - np.array(START)) ** 3 + 2 * (x - np.array(START)))  # fmt: skip
    yield Case("at the origin", "numpy", lambda x: np.expm1(x[0]) - np.sin(x[1]) * 1e-6, [0.0, 0.0],
        lambda x: [np.exp(x[0]), -np.cos(x[1]) * 1e-6])  # fmt: skip
    yield Case("cost of 1e15", "numpy", lambda x: 1e15 * swing(x), START, lambda x: 1e15 * complex_step(swing)(x))
    yield Case("steep wall", "numpy", lambda x: np.log1p(np.exp(300 * (x[0] - x[1]))) / 300 + x[0] ** 2, [0.4, 0.38],
        lambda x: np.array([1.0, -1.0]) / (1 + np.exp(-300 * (x[0] - x[1]))) + [2 * x[0], 0.0])  # fmt: skip


def logistic(x, steps=25):
    """Return the last value of the chaotic logistic map, whose derivative grows to about 1e5."""
    y = x[0]
    for _ in range(steps):
        y = x[1] * y * (1 - y)
    return y


# ------------------------------------------------------------------------------------------------ torch


def torch_cases():
    import torch

    def fall(x, cut=lambda f: f, state=lambda q: q, steps=60):
        q, v = x[0], x[1]
        for _ in range(steps):
            force = -9.81 + cut(200.0 * torch.relu(-q) - 3.0 * torch.relu(-q) * v)
            v = v + 0.01 * force
            q = state(q + 0.01 * v)
        return (q - 0.2) ** 2 + 0.1 * v * v

    def no_grad(force):
        with torch.no_grad():
            return force.clone()

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

    at = [0.05, -0.4]
    cut = ("missing_term",)
    yield Case("detach on the force", "torch", lambda x: fall(x, lambda f: f.detach()), at, "torch", cut)
    yield Case("no_grad on the force", "torch", lambda x: fall(x, no_grad), at, "torch", cut)
    yield Case(
        "item() in the loop",
        "torch",
        lambda x: fall(x, state=lambda q: q * 0 + q.item()),
        at,
        "torch",
        ("disconnected",),
    )
    yield Case("in-place clamp of data", "torch", lambda x: fall(x, state=clamped), at, "torch", cut)
    yield Case("detached altogether", "torch", lambda x: fall(x.detach()), at, "torch", ("disconnected",))
    yield Case("rounded", "torch", lambda x: fall((x * 1e5).long() / 1e5), at, "torch", ("staircase",))
    yield Case("float32 inside", "torch", lambda x: fall(x.float()).double(), at, "torch", warned="precision")
    yield Case(
        "NaN behind where", "torch",
        lambda x: fall(x) + torch.where(x[0] > 0.1, torch.sqrt(x[0] - 0.1), torch.zeros_like(x[0])),
        at, "torch", ("nan_gradient",),
    )  # fmt: skip
    yield Case(
        "norm at 0, squared",
        "torch",
        lambda x: x[1:].pow(2).sum().sqrt() ** 2 + x[0] ** 2,
        [0.3, 0.0],
        "torch",
        ("nan_gradient",),
    )
    yield Case(
        "argmin of a grid",
        "torch",
        lambda x: fall(x) + 0.1 * torch.argmin((torch.linspace(-1, 1, 20001) - x[0]).abs()) / 20000,
        at,
        "torch",
        ("staircase",),
    )
    yield Case(
        "rank by sorting",
        "torch",
        lambda x: (x * torch.argsort(x).double()).sum() + torch.sort(x).indices.double()[0],
        [0.3, 0.3],
        "torch",
        ("jump",),
    )
    yield Case("wrong backward", "torch", lambda x: Halved.apply(x).sum(), [0.3, 0.7], "torch", ("wrong_factor",))

    yield Case("ball on a floor", "torch", fall, at, "torch")
    yield Case("small network", "torch", lambda x: torch.tanh(torch.outer(x, x) @ x).sum(), [0.3, -0.7, 0.2], "torch")
    yield Case(
        "sorted values", "torch", lambda x: (torch.sort(x).values * torch.arange(3)).sum(), [0.3, -0.7, 0.2], "torch"
    )


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
    cut = ("missing_term",)
    yield Case("stop_gradient on contact", "jax", lambda x: push(x, jax.lax.stop_gradient), at, "jax", cut)
    yield Case("stop_gradient on theta", "jax", lambda x: push(jax.lax.stop_gradient(x)), at, "jax", ("disconnected",))
    yield Case("cast to int", "jax", lambda x: push((x * 1e5).astype(int) / 1e5), at, "jax", ("staircase",))
    yield Case("wrong custom_vjp", "jax", lambda x: wrong(x).sum(), at, "jax", ("wrong_factor",))
    yield Case(
        "norm at 0, squared",
        "jax",
        lambda x: jnp.linalg.norm(x[1:]) ** 2 + x[0] ** 2,
        [0.3, 0.0],
        "jax",
        ("nan_gradient",),
    )
    yield Case("float(x) in the loop", "jax", lambda x: push(x) + float(x[0]), at, "jax", ("raised",))

    yield Case("pushing", "jax", push, at, "jax")
    yield Case("stiff, implicit", "jax", lambda x: jnp.sum((x / (1.0 + 1e6 * 1e-3)) ** 2) * 1e6 + jnp.sum(x), at, "jax")
    yield Case("kink beside theta", "jax", lambda x: jnp.sum(jnp.abs(x - 0.1003) * x), [1.0, 0.1], "jax")


def engine_cases():
    """Yield the failures of engines that `mechanisms.py` imitates, and right gradients beside them."""
    import mechanisms as m

    start, random = [0.7, 0.3], np.random.default_rng(0)

    def slope(x, steps=20):
        return m.swinging(x, steps, slope=True)

    def last_digits(x):
        value = m.swinging(x)
        return np.nextafter(value, value + random.integers(-1, 2))

    def seeded(x):
        seed = int(np.frombuffer(np.array(x).tobytes(), np.uint32).sum())
        return m.swinging(x) + 0.38 * np.random.default_rng(seed).standard_normal()

    def raising(x):
        if abs(x[0] - start[0]) > 1e-3:
            raise RuntimeError("no gradient here")
        return 75300 * slope(x)

    def shared(x, steps=20):
        return m.swinging(x, steps, shared=True, slope=True)

    def mixed(x):
        return m.single(x, is_mixed=True)

    solver, by = m.WarmStarted(), "wrong_factor"
    grown = {"horizons": [1, 2, 5, 20]}
    yield Case(
        "adaptive steps", "numpy", lambda x: m.adaptive(x, 1e-3), [1.0, 1.0, 0.5], lambda x: m.frozen(x, rtol=1e-3),
        ("adaptive",),
    )  # fmt: skip
    yield Case("memory overwritten", "numpy", m.swinging, start, shared, ("overwritten",), grown)
    yield Case("warm start", "numpy", solver.cost, [1.0, 2.0], solver.gradient, ("nondeterministic",))
    yield Case("float32 states", "numpy", mixed, start, m.single_gradient, warned="precision")
    yield Case("float32 states, 55% off", "numpy", mixed, start, lambda x: 1.55 * m.single_gradient(x), (by,))
    yield Case("last digits vary, factor 2", "numpy", last_digits, start, lambda x: 2 * slope(x), (by,))
    yield Case("seed from theta", "numpy", seeded, start, slope, ("rough",))
    yield Case(
        "input without effect", "numpy", lambda x: m.swinging(x[:2]), [*start, 1.0], lambda x: np.r_[slope(x[:2]), 0.0],
        ("no_effect",), {"allow_zero": False},
    )  # fmt: skip
    yield Case(
        "no input moves the cost", "numpy", lambda x: 3.3 + 0 * x[0], start, lambda x: 0 * np.array(x), ("zero",)
    )
    yield Case("0.2% off", "numpy", m.swinging, start, lambda x: slope(x) * [1, 1.002], (by,))
    yield Case("1e-5 off", "numpy", m.swinging, start, lambda x: slope(x) * (1 + 1e-5), warned="small error")
    yield Case("raises elsewhere", "numpy", m.swinging, start, raising, (by, "wrong_adjoint"))
    yield Case("last digits vary", "numpy", last_digits, start, slope)
    yield Case(
        "linear beside 1e6", "numpy", lambda x: 1e6 + 3e-4 * x[0] - 1e-9 * x[1], start,
        lambda x: np.array([3e-4, -1e-9]),
    )  # fmt: skip
    yield Case("shared by one step", "numpy", lambda x: m.swinging(x, 1), start, lambda x: shared(x, 1))


CASES = {
    "numpy": numpy_cases,
    "right": right_cases,
    "torch": torch_cases,
    "jax": jax_cases,
    "engines": engine_cases,
}


def examined(case, cost=None, **settings):
    """Return the report on a case, or on a slower cost of it."""
    from bench.examine import examine

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        settings = {"budget": 60, **case.settings, **settings}
        return examine(cost or case.cost, case.theta, grad=case.grad, progress=False, **settings)


def slowed(cost, factor):
    """Return a cost that takes ``factor`` times as long, as on a loaded machine."""

    @functools.wraps(cost)
    def call(*arguments, **settings):
        started = time.perf_counter()
        value = cost(*arguments, **settings)
        time.sleep((factor - 1.0) * (time.perf_counter() - started))
        return value

    return call


def compare_speeds(libraries):
    """Print the cases whose exit status or cause differs where every cost takes four times as long."""
    different = total = 0
    for library in libraries:
        for case, again in zip(CASES[library](), CASES[library](), strict=True):
            total += 1
            for settings in ({"budget": 5}, {"budget": None, "calls": 400}):
                fast = examined(case, **settings)
                slow = examined(again, slowed(again.cost, 4.0), **settings)
                if (fast.status, fast.cause) != (slow.status, slow.cause):
                    different += 1
                    print(
                        f"{library} {case.name} {settings}: {fast.status} {fast.cause}, slower {slow.status} {slow.cause}"
                    )
    print(f"{different} of {2 * total} examinations differ")
    return int(different > 0)


def main(libraries):
    print("| library | case | cause named | as planted | exit | costs | gradients | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    caught = named = faults = right = alarms = 0
    for library in libraries or CASES:
        for case in CASES[library]():
            report = examined(case)
            fits = report.cause in case.causes if case.causes else report.status == 0
            if case.warned:
                fits &= any(case.warned in text for text in report.warnings)
            if case.causes or case.warned:
                faults, caught, named = faults + 1, caught + bool(report.status or case.warned), named + fits
            else:
                right, alarms = right + 1, alarms + bool(report.status)
            print(
                f"| {library} | {case.name} | {report.cause} | {'yes' if fits else 'NO'} | {report.status} "
                f"| {report.costs} | {report.gradients} | {report.seconds:.2f} |",
                flush=True,
            )
    print(f"\n{caught} of {faults} faults caught, {named} named as planted, {alarms} false alarms of {right}")
    return 0 if named == faults and not alarms else 1


if __name__ == "__main__":
    started = time.perf_counter()
    words = sys.argv[1:]
    status = compare_speeds(words[1:] or ["numpy", "right", "engines"]) if words[:1] == ["slowed"] else main(words)
    print(f"{time.perf_counter() - started:.0f} s in all")
    sys.exit(status)
