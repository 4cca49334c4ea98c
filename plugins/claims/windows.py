"""L1 and L2: short windows need a terminal value, and a curve can be scored on another objective than it minimised."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import function, problem
from bench.model import Array, FunctionScene

EFFORT, VALUE, GAIN = 10.0, 3.701562, 0.270156


def window(steps: int, value: float = 0.0) -> FunctionScene:
    """Return the controls of a short window of the plant x' = x + u from x = 1: f = sum (x^2 + 10 u^2) + value x_H^2."""

    def cost(xp: Any, x: Array) -> Array:
        state, total = 1.0 + 0.0 * x[0], 0.0
        for t in range(steps):
            total = total + state * state + EFFORT * x[t] * x[t]
            state = state + x[t]
        return total + value * state * state

    return function(cost, np.zeros(steps), 0.1)


class Windows(Claim):
    """Short windows with and without a terminal value."""

    name = "L1"
    lesson = "Windows and objectives"
    statement = (
        "A short window with the right value at its end has the optimum of the endless problem; without one its gain, and "
        "the cost, are off by a share that falls geometrically with its length."
    )
    source = "Xu et al. 2022 (idea); closed form by Riccati steps"
    learned = "Cutting a rollout is cheap only if its end is worth something."
    origin = "recomputed"
    quantity = "gain of the first control"
    marks = (("y", GAIN, "endless problem"),)
    revision = 2

    def measure(self) -> Outcome:
        """Compute the optimum of each window from its gradient, which is linear in the controls."""
        published = {
            1: ("0.0", ""),
            2: ("0.090909", "0.68526"),
            3: ("0.160305", "0.15146"),
            4: ("0.206541", "0.04044"),
            5: ("0.234621", "0.01129"),
            6: ("0.250723", "0.00319"),
        }
        figures: list[Figure] = []
        gains = {}
        best = _infinite_horizon_cost(GAIN)
        for steps, (gain, excess) in published.items():
            plain = _first_gain(steps)
            figures.append(Figure(f"gain of a window of {steps}", gain, plain, 1e-9))
            if excess:
                off = _infinite_horizon_cost(plain) / best - 1
                figures.append(Figure(f"excess cost of a window of {steps}", excess, off, 1e-9))
            valued = _first_gain(steps, VALUE)
            gains[steps] = plain, valued
            figures.append(Figure(f"gain of a window of {steps} with the value", "0.270156", valued, 1e-7))
        names = "no value at the end", "its value at the end"
        return Outcome(
            figures,
            series={"window H": list(gains)}
            | dict(zip(names, map(list, zip(*gains.values(), strict=True)), strict=True)),
        )


def _first_gain(d: int, value: float = 0.0) -> float:
    """Return -u_0 of the optimal controls. The gradient is linear, so d + 1 gradients give the optimum."""
    at = problem(window(d, value))
    points = np.concatenate([np.zeros((d, 1)), np.eye(d)], axis=1)
    gradient = at.grad(points, np.zeros((d, d + 1)))
    hessian = gradient[:, 1:] - gradient[:, :1]
    return float(-np.linalg.solve(hessian, -gradient[:, 0])[0])


def _infinite_horizon_cost(gain: float) -> float:
    """Return the infinite-horizon cost of the policy u = -gain x from x = 1."""
    return (1 + EFFORT * gain * gain) / (1 - (1 - gain) ** 2)


class OtherObjective(Claim):
    """An iLQR curve and the objective that it minimises."""

    name = "L2"
    lesson = "Windows and objectives"
    statement = "iLQR swings a pendulum up in five iterations: 1856.154, 1202.106, 699.799, 423.583, 357.476, 357.297."
    source = "Suh et al. 2021, Bundled gradients, public result file"
    origin = "data file"
    learned = "The same method ends higher if it is given other weights than it is scored with: say which objective was given."
    quantity = "cost with weights 1 and 1, above the least, 349.49"
    logarithmic = "y"

    def measure(self) -> Outcome:
        """Run iLQR with weights 1/2 and 20 and with weights 1 and 1, both scored with 1 and 1."""
        published = ("1856.154", "1202.106", "699.799", "423.583", "357.476", "357.297")
        given = _ilqr(effort=0.5, terminal=20.0, iterations=5)
        scored = _ilqr(effort=1.0, terminal=1.0, iterations=25)
        figures = [
            Figure(f"iteration {i}", text, cost, spread=2e-3)
            for i, (text, cost) in enumerate(zip(published, given, strict=True))
        ]
        figures.append(Figure("least cost when it is the one minimised", "349.490454", scored[-1], spread=2e-4))
        return Outcome(
            figures,
            reservation=(
                "the curve solves with control weight 1/2 and terminal weight 20 and is scored with 1 and 1: it ends "
                f"{given[-1] / scored[-1] - 1:.1%} above what the same method reaches when given the objective it is scored on"
            ),
            series={
                "iteration": list(range(6)),
                "given weights 1/2 and 20": np.array(given) - scored[-1],
                "given weights 1 and 1": np.array(scored[:6]) - scored[-1],
            },
        )


def _ilqr(effort: float, terminal: float, iterations: int) -> list[float]:
    """Return the costs, with weights 1 and 1, of full-step iLQR iterates that minimise the cost with other weights."""
    dt, horizon = 0.05, 200
    scene = f"pendulum_swing[horizon={horizon},dt={dt!r},effort={{}},terminal={{}}]"
    given, scored = problem(scene.format(effort, terminal)), problem(scene.format(1.0, 1.0))
    still = np.zeros((horizon, 1))
    u = np.full(horizon, 0.1)
    costs = [float(scored.value(u, still)[0])]
    goal = np.array([np.pi, 0.0])
    for _ in range(iterations):
        parts = given.jacobians(u, still)
        x, a, b = parts.states[:, :, 0], parts.a[..., 0], parts.b[..., 0]
        vx, vxx = 2 * terminal * (x[-1] - goal), 2 * terminal * np.eye(2)
        feedback, feedforward = np.empty((horizon, 2)), np.empty(horizon)
        for t in reversed(range(horizon)):
            qu = 2 * effort * u[t] + b[t][:, 0] @ vx
            quu = 2 * effort + b[t][:, 0] @ vxx @ b[t][:, 0]
            qux = b[t][:, 0] @ vxx @ a[t]
            feedback[t], feedforward[t] = -qux / quu, -qu / quu
            vx = 2 * (x[t] - goal) + a[t].T @ vx + qux * feedforward[t]
            vxx = 2 * np.eye(2) + a[t].T @ vxx @ a[t] - np.outer(qux, qux) / quu
        state, new = x[0].copy(), np.empty(horizon)
        for t in range(horizon):
            new[t] = u[t] + feedforward[t] + feedback[t] @ (state - x[t])
            velocity = state[1] + dt * (new[t] - np.sin(state[0]))
            state = np.array([state[0] + dt * velocity, velocity])
        u = new
        costs.append(float(scored.value(u, still)[0]))
    return costs
