"""Counts false alarms: how often the gradient check reports a fault in correct gradients of smooth scenes.

    python tests/programs/false_alarms.py 5000

runs 5,000 checks at random thetas and horizons up to 3,000, and prints the counts of verdicts, every reported fault, and the
seconds per check. The first check of a program includes its compilation.
"""

import sys
import time
from collections import Counter

import numpy as np

from bench.measure.gradcheck import FAULTS
from bench.model import compose, registry
from bench.studies.gradient_check import measure

SCENES = (
    "pendulum", "double_pendulum", "cartpole", "mass_spring", "double_integrator", "stiff_decay", "quadratic",
    "rosenbrock", "cubic",
)  # fmt: skip
HORIZONS = (1, 30, 300, 1000, 2000, 3000)
INTEGRATORS = ("semi_implicit_euler", "rk4")
SPREAD = 0.3
"""Standard deviation of theta around the scene's theta0, relative to each component (absolute where theta0 is 0)."""


def programs():
    """Yield name and program of every smooth scene, at every horizon and with every integrator if it has time steps."""
    for name in SCENES:
        entry = registry.entries()["scenes"].get(name)
        if entry is None:
            continue
        stepped = hasattr(entry.plugin, "n_q")
        for horizon in HORIZONS if stepped else (None,):
            for integrator in INTEGRATORS if stepped else (None,):
                values = {} if horizon is None else {"horizon": horizon}
                method = None if integrator is None else registry.make("integrators", integrator, {})
                yield f"{name} {horizon} {integrator}", compose(registry.make("scenes", name, values), None, method)


def run(count, only=None):
    """Run ``count`` checks; returns counts by verdict, false alarms ``(name, seed, sentence)``, and seconds per check."""
    chosen = [(name, program) for name, program in programs() if only is None or only(name)]
    verdicts, blamed, seconds = Counter(), [], []
    unit, search = float(np.finfo(np.float64).eps), measure.SwitchSearch(2, 16, 2.0, 1e-4)
    for place, (name, program) in enumerate(chosen):
        problem = registry.make("backends", "jax", {}).compile(program)
        theta0 = program.theta0
        for seed in range(place, count, len(chosen)):
            scale = np.where(theta0 == 0.0, 1.0, np.abs(theta0))
            theta = theta0 + SPREAD * scale * np.random.default_rng(seed).standard_normal(theta0.size)
            started = time.perf_counter()
            found = measure.start(problem, theta, unit, search, seed)
            seconds.append(time.perf_counter() - started)
            verdicts[found.cause] += 1
            if found.cause in FAULTS:
                blamed.append((name, seed, found.sentence()))
                print("blamed:", *blamed[-1], flush=True)
    return verdicts, blamed, seconds


if __name__ == "__main__":
    verdicts, blamed, seconds = run(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
    print(f"{sum(verdicts.values())} checks: " + ", ".join(f"{n} {name}" for name, n in verdicts.most_common()))
    print(f"{len(blamed)} gradients of right programs blamed")
    print(f"seconds of a check: median {np.median(seconds):.3f}, largest {max(seconds):.1f}")
