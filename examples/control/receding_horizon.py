"""A pendulum swung up under noise: plans made once against plans made again at each step (MPPI, CEM, iLQR)."""

from dataclasses import dataclass

import numpy as np
from bench.plugins.backends.numpy import Numpy
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.optimizers.cem import Cem
from bench.plugins.optimizers.mppi import Mppi
from bench.plugins.scenes.pendulum_swing import PendulumSwing
from scipy.stats import t as student

from bench.plugin import Answer, LoopOps, State, compose, param, slopes

STEPS, AHEAD = 60, 25
"""Steps of 0.1 s in a run, and at most in a plan that is made again."""
ITERATIONS = 4
"""Iterations of a plan at each step."""
SHARES = 0.5 ** np.arange(10)
"""Shares of a change of all controls that iLQR tries."""
SUFFICIENT = 1e-4
"""Share of the predicted descent that iLQR requires."""
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


def sampled(optimizer):
    """Return a planner ``(problem, theta, rng) -> theta`` that improves controls by an optimizer on the cost without noise."""

    def improved(problem, theta, rng):
        state = optimizer.start(theta)
        for _ in range(ITERATIONS):
            points = optimizer.ask(state, rng.standard_normal((problem.dim, optimizer.draws(problem.dim))))
            state = optimizer.tell(state, points, Answer(problem.value(points, np.zeros_like(points))))
        return state["theta"]

    return improved


def ilqr(problem, theta, rng=None, iterations=ITERATIONS):
    """Return controls ``(T,)`` improved by the iterative linear-quadratic regulator (Li, Todorov 2004).

    Trial rollouts apply shares of the regulator's changes with the whole gains, so that they stay near the plan.
    """
    for _ in range(iterations):
        path = slopes(problem, theta, np.zeros((problem.dim, 1)))
        changes, gains, descent, curvature = regulator(problem.program.scene, path)
        states = path.states[:, :, 0]
        for share in SHARES:
            controls, cost = followed(problem, theta + share * changes, gains, states)
            if path.cost.sum() - cost > SUFFICIENT * (share * descent - 0.5 * share**2 * curvature):
                theta = controls
                break
    return theta


def regulator(scene, path):
    """Return changes ``(T,)``, gains ``(T, 2)``, and slope and curvature of the descent along the changes.

    They minimise the cost of the linearised steps. The second derivatives of this scene's cost are constants.
    """
    a, b, cost_x, cost_u = path.a[..., 0], path.b[:, :, 0, 0], path.cost_x[..., 0], path.cost_u[:, 0, 0]
    changes, gains, descent, curvature = np.empty(len(b)), np.empty((len(b), 2)), 0.0, 0.0
    value_x, value_xx = cost_x[-1], 2.0 * scene.terminal * np.eye(2)
    for t in reversed(range(len(b))):
        x, u = cost_x[t] + a[t].T @ value_x, cost_u[t] + b[t] @ value_x
        xx, ux = 2.0 * np.eye(2) + a[t].T @ value_xx @ a[t], b[t] @ value_xx @ a[t]
        uu = 2.0 * scene.effort + b[t] @ value_xx @ b[t]
        changes[t], gains[t] = -u / uu, -ux / uu
        descent, curvature = descent + u**2 / uu, curvature + u**2 / uu
        value_x, value_xx = x + ux * changes[t], xx + np.outer(ux, gains[t])
    return changes, gains, descent, curvature


def followed(problem, plan, gains, states):
    """Return controls ``(T,)`` and cost of the rollout under the plan plus gains times the distance from ``states (T + 1, 2)``."""
    controls = []

    def control(t, x):
        controls.append(plan[t] + gains[t] @ (x - states[t]))
        return controls[-1]

    cost = run_cost(control, 0.0, np.zeros(len(plan)), problem.program)
    return np.array(controls), cost


def best_plan():
    """Return the best controls without noise, their cost, states ``(STEPS + 1, 2)`` and gains ``(STEPS, 2)``."""
    problem = swing(STEPS)
    theta = ilqr(problem, problem.program.theta0, iterations=30)
    path = slopes(problem, theta, np.zeros((STEPS, 1)))
    return theta, float(path.cost.sum()), path.states[:, :, 0], regulator(problem.program.scene, path)[1]


def run_cost(control, sigma, noise, program=None):
    """Return the cost of one run under ``control(t, x)``, to which sigma times ``noise (T,)`` is added."""
    program, ops, total = program or swing(STEPS).program, LoopOps(), 0.0
    state = program.scene.initial_state(np, np.zeros((1, 1)))
    for t in range(len(noise)):
        u = np.full((1, 1), control(t, np.concatenate(state)[:, 0]) + sigma * noise[t])
        total += program.scene.stage_cost(np, *state, u)[0]
        state = program.step(ops, state, u)
    return float(total + program.scene.terminal_cost(np, *state)[0])


def receding(planner, seed):
    """Return a law that improves a plan from the present state, applies its first control and shifts the rest."""
    plan, rng = np.full(AHEAD, 0.1), np.random.default_rng([seed, 1])

    def control(t, x):
        nonlocal plan
        problem = swing(min(AHEAD, STEPS - t), *x)
        theta = planner(problem, plan[: problem.dim], rng)
        plan = np.append(theta[1:], 0.0)
        return theta[0]

    return control


def laws(seed):
    """Return the control laws by name."""
    theta, _, states, gains = PLAN
    return {
        "plan made once": lambda t, x: theta[t],
        "plan made once, with gains": lambda t, x: theta[t] + gains[t] @ (x - states[t]),
        "MPPI at each step": receding(sampled(Mppi(population=64, width=1.0, temperature=0.1)), seed),
        "CEM at each step": receding(sampled(Cem(population=64, elites=8, width=1.0)), seed),
        "iLQR at each step": receding(ilqr, seed),
    }


def costs(sigma, seeds):
    """Return the costs of the seeds by law. All laws meet the same noise."""
    noises = [np.random.default_rng(seed).standard_normal(STEPS) for seed in seeds]
    return {
        name: np.array([run_cost(laws(s)[name], sigma, w) for s, w in zip(seeds, noises, strict=True)])
        for name in laws(0)
    }


def interval(values):
    """Return the mean with its 95% interval by Student's t."""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    mean, low, high = (f"{x:,.0f}" for x in (values.mean(), values.mean() - half, values.mean() + half))
    return f"{mean} [{low}, {high}]"


def table(sigmas=SIGMAS, seeds=SEEDS):
    """Return a table in Markdown: the mean cost of each law, with a column per sigma."""
    by_sigma = [costs(sigma, range(seeds)) for sigma in sigmas]
    text = f"| law | {' | '.join(f'cost at sigma {sigma}' for sigma in sigmas)} |\n|---|{'--:|' * len(sigmas)}\n"
    for name in by_sigma[0]:
        text += f"| {name} | {' | '.join(interval(by_law[name]) for by_law in by_sigma)} |\n"
    return text


PLAN = best_plan()

if __name__ == "__main__":
    print(f"Least cost without noise: {PLAN[1]:.1f}\n\n{table()}")
