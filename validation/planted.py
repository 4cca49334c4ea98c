"""Prints which planted faults ``compare`` detects, by scene: ``python validation/planted.py [SCENE ...]``.

Every cell runs in this process on the NumPy backend, without and with each fault. The fault is in the problem that both the
estimates and the reference use, as if the next version of a simulator were broken.
"""

import sys
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers import loaded

from bench.compare import cells
from bench.model import Problem, registry
from bench.run import tasks
from bench.run.session import RunSession

SHORT = (
    "pushing",
    "cartpole",
    "double_pendulum",
    "pendulum",
    "hopper",
    "friction_block",
    "tossed_box",
    "mass_spring",
    "ground_wall",
    "bouncing_ball",
)
"""Scenes whose horizon is set to ten steps."""
WORDS = (
    "contacts=[penalty]",
    "backends=[numpy]",
    "estimators=[fobg]",
    "sweep.sigma=[0.1]",
    "samples=16",
    "repeats=16",
    "reference.samples=4096",
    "reference.tolerance=0.1",
    "timing=false",
)


def _scaled(factor, gradient):
    return factor * gradient


def _flipped(gradient):
    return gradient * np.where(np.arange(len(gradient)) == 0, -1.0, 1.0)[:, None]


def _noisy(share, gradient):
    generator = np.random.default_rng(0)
    return gradient * (1 + share * generator.standard_normal(gradient.shape))


GRADIENTS = {
    "gradient * 1.02": partial(_scaled, 1.02),
    "gradient * 1.05": partial(_scaled, 1.05),
    "gradient * 1.1": partial(_scaled, 1.1),
    "sign of one component": _flipped,
    "1% noise on the gradient": partial(_noisy, 0.01),
}
FAULTS = ("none", *GRADIENTS, "sigma * 1.05")


@contextmanager
def planted(fault):
    """Plant a fault in every problem while the context is open."""
    grad, value = Problem.grad, Problem.value
    stretch = 1.05 if fault.startswith("sigma") else 1.0
    change = GRADIENTS.get(fault, lambda gradient: gradient)

    def faulty_grad(self, theta, w):
        return change(grad(self, theta, stretch * w))

    def faulty_value(self, theta, w):
        return value(self, theta, stretch * w)

    Problem.grad, Problem.value = faulty_grad, faulty_value  # type: ignore[method-assign]
    try:
        yield
    finally:
        Problem.grad, Problem.value = grad, value  # type: ignore[method-assign]


def rows(scene, fault):
    """Return the study's columns, and the rows of a scene's runnable cells with a fault."""
    more = [f"scene.{scene}.horizon=10"] if scene in SHORT else []
    made, found = loaded(f"scenes=[{scene}]", *WORDS, *more)
    with planted(fault):
        session = RunSession(made)
        table = []
        for cell in found:
            refused = cell.refusal()
            if refused is None:
                table.append(tasks.blank_row(made, cell) | tasks.measure_cell(cell, session, made.study))
    return made.columns, made.columns.typed(pd.DataFrame(table))


def judged(scene, faults=FAULTS):
    """Return the line of the comparison for each fault and cell of a scene; empty if no cell can run."""
    columns, before = rows(scene, "none")
    if before.empty:
        return before
    parts = []
    for fault in faults:
        table, _ = cells.compare_cells(before, rows(scene, fault)[1], columns)
        parts.append(table.assign(fault=fault))
    return pd.concat(parts)


def main():
    """Print, per scene and fault, the outcome of the comparison for the estimator fobg."""
    for scene in sys.argv[1:] or sorted(registry.entries()["scenes"]):
        found = judged(scene)
        if found.empty:
            print(f"{scene:18} not run by the NumPy backend")
            continue
        good = found[found["status_before"] == "ok"]
        for name, part in good.groupby("estimator", sort=False):
            print(
                f"{scene:18} {name:22}",
                "  ".join(f"{f}: {o}" for f, o in zip(part["fault"], part["outcome"], strict=True)),
                flush=True,
            )
        for status in found.loc[found["status_before"] != "ok", "status_before"].unique():
            print(f"{scene:18} {status}")


if __name__ == "__main__":
    main()
