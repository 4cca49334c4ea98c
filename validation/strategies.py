"""Difference strategies on the bank of `simulators.py`, as a table: `python validation/strategies.py`.

Each gets a cost and a gradient and accepts or rejects. Counted are right gradients that it rejects, faults that it accepts,
and evaluations of the cost per case. A gradient that raises an exception is rejected by all.
"""

from __future__ import annotations

import warnings

import numpy as np
import simulators

DRAW = np.random.default_rng(0)


def central(f, x, direction, step):
    """Return the slope along a direction by central differences."""
    return (f(x + step * direction) - f(x - step * direction)) / (2 * step)


def is_close(slope, expected, absolute, relative):
    return bool(np.all(np.abs(slope - expected) <= absolute + relative * np.abs(expected)))


def components(f, g, x, step=1e-6, absolute=1e-5, relative=1e-3):
    """`torch.autograd.gradcheck`: every component, step 1e-6, tolerances 1e-5 and 1e-3."""
    return is_close(g(x), np.array([central(f, x, e, step) for e in np.eye(len(x))]), absolute, relative)


def projection(f, g, x):
    """`gradcheck(fast_mode=True)`: one random direction, as above."""
    along = DRAW.standard_normal(len(x))
    along /= np.linalg.norm(along)
    return is_close(g(x) @ along, central(f, x, along, 1e-6), 1e-5, 1e-3)


def direction(f, g, x):
    """`jax.test_util.check_grads`: one random direction, step 1e-4, tolerances 1e-5."""
    along = DRAW.standard_normal(len(x))
    return is_close(g(x) @ along, central(f, x, along, 1e-4), 1e-5, 1e-5)


def sweep(f, g, x):
    """The best of ten steps from 0.1 to 1e-10, every component, within 1e-3 of the gradient's norm."""
    slope = g(x)
    found = [[central(f, x, e, step) for e in np.eye(len(x))] for step in 10.0 ** -np.arange(1, 11)]
    return min(np.linalg.norm(found - slope, axis=1)) <= 1e-3 * np.linalg.norm(slope)


def normalised(f, g, x):
    """Every component, with steps of 1e-6 of its input, within 1e-3 of itself or of the largest scaled component."""
    scale = np.where(x == 0, 1.0, np.abs(x))
    found = np.array([central(f, x, s * e, 1e-6) for s, e in zip(scale, np.eye(len(x)), strict=True)])
    return is_close(g(x) * scale, found, 1e-6 * np.abs(found).max(), 1e-3)


def taylor(f, g, x):
    """The order of the remainder along a random direction over six halvings from 0.01: at least 1.8, or all rounding."""
    along, steps = DRAW.standard_normal(len(x)), 0.01 * 0.5 ** np.arange(7)
    first, slope = f(x), g(x) @ along
    rest = np.array([abs(f(x + step * along) - first - step * slope) for step in steps])
    if rest.max() <= 1e-12 * max(abs(first), abs(slope)):
        return True
    return bool(np.polyfit(np.log(steps), np.log(rest + 1e-300), 1)[0] >= 1.8)


def warp(f, g, x):
    """`warp.autograd.gradcheck`: every component, step 1e-4, tolerances 1e-3 and 1e-2; in float64 here."""
    return components(f, g, x, 1e-4, 1e-3, 1e-2)


def functions(case):
    """Return a case's cost and gradient of a NumPy array."""
    extra = [DRAW.standard_normal(count) for count in [case.settings.get("noise", 0)] if count]
    if case.grad == "torch":
        import torch

        def torch_gradient(x):
            x = torch.tensor(x, requires_grad=True)
            return torch.autograd.grad(case.cost(x), x, materialize_grads=True)[0].numpy()

        return lambda x: float(case.cost(torch.tensor(x))), torch_gradient
    if case.grad == "jax":
        import jax
        import jax.numpy as jnp

        cost, gradient = jax.jit(case.cost), jax.jit(jax.grad(case.cost))
        return lambda x: float(cost(jnp.asarray(x))), lambda x: np.asarray(gradient(jnp.asarray(x)))
    return lambda x: float(case.cost(x, *extra)), lambda x: np.asarray(case.grad(x, *extra), dtype=float)


def judged(case, strategy):
    """Return whether a strategy accepts a case's gradient, and how many costs it evaluates."""
    f, g = functions(case)
    calls = []
    try:
        return strategy(lambda x: calls.append(0) or f(x), g, np.array(case.theta, dtype=float)), len(calls)
    except Exception:
        return False, len(calls)


def main():
    """Print the table: a line per strategy."""
    bank = [*simulators.right_cases(), *simulators.torch_cases(), *simulators.jax_cases()]
    n_faults = sum(bool(case.causes) for case in bank)
    print(f"| strategy | right of {len(bank)} | missed of {n_faults} faults | false alarms | costs per case |")
    print("|---|--:|--:|--:|--:|")
    for strategy in (components, projection, direction, sweep, normalised, taylor, warp):
        found = [judged(case, strategy) for case in bank]
        missed = [case.name for case, (accepts, _) in zip(bank, found, strict=True) if case.causes and accepts]
        alarms = [case.name for case, (accepts, _) in zip(bank, found, strict=True) if not case.causes and not accepts]
        costs, right = sum(count for _, count in found) / len(bank), len(bank) - len(missed) - len(alarms)
        print(
            f"| {strategy.__name__} | {right} | {'; '.join(missed)} | {'; '.join(alarms)} | {costs:.0f} |", flush=True
        )


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
