"""Counts false alarms: how often the gradient check reports a fault in correct gradients of smooth scenes.

    python validation/false_alarms.py 5000 [FIRST]

runs the checks FIRST to 4,999 at random thetas and horizons up to 3,000, and prints every reported fault and the counts of
verdicts. A check's number determines its program and theta, so ranges can run apart or in turn. Short horizons are checked
more often, because a check takes as long as its horizon.
"""

import sys
from collections import Counter

import numpy as np
from bench.plugins.studies.gradient_check import GradientCheck, measure

from bench.gradient import FAULTS
from bench.model import compose, registry

SCENES = (
    "pendulum",
    "double_pendulum",
    "cartpole",
    "mass_spring",
    "double_integrator",
    "stiff_decay",
    "quadratic",
    "rosenbrock",
    "cubic",
)
HORIZONS = {1: 8, 30: 8, 300: 5, 1000: 2, 2000: 1, 3000: 1}
"""Numbers of steps, and how many checks of a cycle have each."""
ELSE = 16
"""Checks of a cycle for each scene without time steps."""
INTEGRATORS = ("semi_implicit_euler", "rk4")
SPREAD = 0.3
"""Standard deviation of theta around the scene's theta0, relative to each component (absolute where theta0 is 0)."""


def programs():
    """Yield name, program and weight of every smooth scene, at every horizon and with every integrator."""
    for name in SCENES:
        entry = registry.entries()["scenes"].get(name)
        if entry is None:
            continue
        is_stepped = hasattr(entry.plugin, "n_q")
        for horizon, weight in HORIZONS.items() if is_stepped else ((None, ELSE),):
            for integrator in INTEGRATORS if is_stepped else (None,):
                values = {} if horizon is None else {"horizon": horizon}
                method = None if integrator is None else registry.make("integrators", integrator, {})
                program = compose(registry.make("scenes", name, values), None, method)
                yield f"{name} {horizon} {integrator}", program, weight


def run(count, only=None, first=0):
    """Run the checks ``first`` to ``count - 1``, program by program.

    Returns lines ``(number, name, verdict)``.
    """
    chosen = [entry for entry in programs() if only is None or only(entry[0])]
    cycle = [place for place, entry in enumerate(chosen) for _ in range(entry[2])]
    lines = []
    unit, search = float(np.finfo(np.float64).eps), GradientCheck()
    for place, (name, program, _) in enumerate(chosen):
        numbers = [n for n in range(first, count) if cycle[n % len(cycle)] == place]
        problem = registry.make("backends", "jax", {}).compile(program) if numbers else None
        theta0 = program.theta0
        for number in numbers:
            scale = np.where(theta0 == 0.0, 1.0, np.abs(theta0))
            theta = theta0 + SPREAD * scale * np.random.default_rng(number).standard_normal(theta0.size)
            result = measure.start(problem, theta, unit, search, number)
            lines.append((number, name, result.cause))
            if result.cause in FAULTS:
                print("blamed:", number, name, result.sentence(), flush=True)
    return lines


if __name__ == "__main__":
    count, first = (*map(int, sys.argv[1:3]), 0)[:2]
    lines = run(count, first=first)
    print(Counter(line[2] for line in lines))
    print(f"{len(lines)} checks: {sum(line[2] in FAULTS for line in lines)} gradients of right programs blamed")
