"""A pendulum swung up under noise: plans made once against plans made again at each step (MPPI, CEM, iLQR)."""

from dataclasses import dataclass

import numpy as np
from bench.plugins.backends.numpy import Numpy
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.optimizers.cem import Cem
from bench.plugins.optimizers.ilqr import Ilqr
from bench.plugins.optimizers.mppi import Mppi
from bench.plugins.scenes.pendulum_swing import PendulumSwing
from scipy.stats import t as student

from bench.plugin import Answer, LoopOps, State, compose, param

STEPS, AHEAD = 60, 25
"""Steps of 0.1 s in a run, and at most in a plan that is made again."""
ITERATIONS = 4
"""Iterations of the optimizer at each step."""
SIGMAS, SEEDS = (0.3, 1.0), 20


@dataclass(frozen=True)
class From(PendulumSwing):
    """The swing from any state."""

    dt: float = param(0.1, "length of a time step", "s")
    angle: float = param(0.0, "angle at the start", "rad")
    rate: float = param(0.0, "angular velocity at the start", "rad/s")

    def initial_state(self, xp, theta):
        """Return the given state."""
        return State(0.0 * theta[:1] + self.angle, 0.0 * theta[:1] + self.rate)


def swing(steps, angle=0.0, rate=0.0):
    """Return the problem of some steps from a state."""
    return Numpy().compile(compose(From(horizon=steps, angle=angle, rate=rate), None, SemiImplicitEuler()))


def improved(optimizer, state, problem, rng):
    """Return the optimizer's state after one iteration on the cost without noise."""
    points = optimizer.ask(state, rng.standard_normal((problem.dim, optimizer.draws(problem.dim))))
    if "path" in optimizer.needs:
        return optimizer.tell(state, points, Answer(path=optimizer.expansion(problem, Numpy(), state["theta"])))
    return optimizer.tell(state, points, Answer(problem.value(points, np.zeros_like(points))))


def best_plan():
    """Return the best controls without noise, their cost, states ``(STEPS + 1, 2)`` and gains ``(STEPS, 1, 2)``."""
    problem, optimizer = swing(STEPS), Ilqr()
    state = optimizer.start(problem.program.theta0)
    for _ in range(30):
        state = improved(optimizer, state, problem, np.random.default_rng(0))
    path = optimizer.expansion(problem, Numpy(), state["theta"])
    states = problem.trajectory(state["theta"], np.zeros((STEPS, 1))).states[:, :, 0]
    return state["theta"], path.cost, states, optimizer.backward(path, 0.0)[1]


def run_cost(control, sigma, noise):
    """Return the cost of one run under ``control(t, x)``, to which sigma times ``noise (STEPS,)`` is added."""
    program, ops, state, total = swing(STEPS).program, LoopOps(), State(np.zeros((1, 1)), np.zeros((1, 1))), 0.0
    for t in range(STEPS):
        u = np.full((1, 1), control(t, np.concatenate(state)[:, 0]) + sigma * noise[t])
        total += program.scene.stage_cost(np, *state, u)[0]
        state = program.step(ops, state, u)
    return float(total + program.scene.terminal_cost(np, *state)[0])


def receding(optimizer, seed):
    """Return a law that improves a plan from the present state, applies its first control and shifts the rest."""
    plan, rng = np.full(AHEAD, 0.1), np.random.default_rng([seed, 1])

    def control(t, x):
        nonlocal plan
        problem = swing(min(AHEAD, STEPS - t), *x)
        state = optimizer.start(plan[: problem.dim])
        for _ in range(ITERATIONS):
            state = improved(optimizer, state, problem, rng)
        plan = np.append(state["theta"][1:], 0.0)
        return state["theta"][0]

    return control


def laws(seed):
    """Return the control laws by name."""
    theta, _, states, gains = PLAN
    return {
        "plan made once": lambda t, x: theta[t],
        "plan made once, with gains": lambda t, x: theta[t] + float(gains[t, 0] @ (x - states[t])),
        "MPPI at each step": receding(Mppi(population=64, width=1.0, temperature=0.1), seed),
        "CEM at each step": receding(Cem(population=64, elites=8, width=1.0), seed),
        "iLQR at each step": receding(Ilqr(), seed),
    }


def costs(sigma, seeds):
    """Return the costs of the seeds by law. All laws meet the same noise."""
    noises = [np.random.default_rng(seed).standard_normal(STEPS) for seed in seeds]
    return {
        name: np.array([run_cost(laws(s)[name], sigma, w) for s, w in zip(seeds, noises, strict=True)])
        for name in laws(0)
    }


def interval(values, digits=0):
    """Return the mean with its 95% interval by Student's t."""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    mean, low, high = (f"{x:,.{digits}f}" for x in (values.mean(), values.mean() - half, values.mean() + half))
    return f"{mean} [{low}, {high}]"


def table(sigmas=SIGMAS, seeds=SEEDS):
    """Return a table in Markdown: mean costs, and by how much they exceed the cost of the plan with gains."""
    text = "| sigma | law | cost | above the plan with gains |\n|--:|---|--:|--:|\n"
    for sigma in sigmas:
        by_law = costs(sigma, range(seeds))
        least = by_law["plan made once, with gains"]
        for name, values in by_law.items():
            above = "" if values is least else interval(values - least, 1)
            text += f"| {sigma} | {name} | {interval(values)} | {above} |\n"
    return text


PLAN = best_plan()

if __name__ == "__main__":
    print(f"Least cost without noise: {PLAN[1]:.1f}\n\n{table()}")
