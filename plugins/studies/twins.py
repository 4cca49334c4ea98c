"""Compares a physics engine's twin of a scene with the scene's own program: one rollout, its cost and its gradient.

A difference is the model error between two programs with the same masses, springs and step. Each gradient may be exact
for its own program. Times are for a batch of ``samples`` rollouts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, exact, numbers, seconds, text
from bench.experiment.experiment import Experiment
from bench.experiment.reference_backends import capable_backends
from bench.experiment.session import Session
from bench.experiment.views import Chart, Mark, Views
from bench.measure import timing
from bench.model import Unsupported, param

from . import StudyPackage, finite_status, first_batch, gradient_seconds, norm, relative_error

if TYPE_CHECKING:
    import pandas as pd

FLOOR = 1e-17
"""Smallest difference that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
PARTED = 1e-6
"""Relative difference of states from which on two engines have parted."""
SHOWN = (
    "state_difference",
    "state_difference_rel",
    "cost_difference_rel",
    "gradient_difference_rel",
    "gradient_cosine",
    "value_s",
    "gradient_s",
    "compile_s",
)
NOTES = (
    "Differences between the engine's twin and the scene's own program at theta without noise. Difference of states: the "
    "largest over the rollout; relative: in units of the coordinate's largest value. Times are of one batch of `samples` "
    "rollouts; compilation is of the gradient.",
)


@dataclass(frozen=True)
class Twins(StudyPackage):
    """Measures the difference between a physics engine's twin and the scene's own program, and the time of gradients."""

    name = "twins"
    timed = True
    columns = Columns.of(
        Column("state_difference", "largest difference of states over time and coordinates", label="states"),
        exact(
            "state_difference_rel",
            "largest difference of states, each coordinate in units of its largest value",
            "difference of states",
            "states, relative",
        ),
        Column("cost", "cost of the twin"),
        Column("own_cost", "cost of the scene's own program"),
        Column("cost_difference_rel", "relative difference of the costs", label="cost, relative"),
        Column("gradient_norm", "norm of the twin's gradient"),
        Column("own_gradient_norm", "norm of the own program's gradient"),
        exact(
            "gradient_difference_rel",
            "relative difference of the gradients",
            "difference of gradients",
            "gradient, relative",
        ),
        Column("gradient_cosine", "cosine between the gradients", label="cosine"),
        seconds("value_s", "time of the costs of `samples` rollouts", "costs"),
        seconds("gradient_s", "time of the gradients of `samples` rollouts", "gradients"),
        Column("trace_s", "part of compile_s: tracing the Python code", "s", measured=True),
        Column("lower_s", "part of compile_s: lowering the trace to the compiler's input", "s", measured=True),
        seconds("compile_s", "total time of compiling the gradient", "compilation"),
        text("own_backend", "backend of the scene's own program"),
        numbers("gradient", "the twin's gradient, by coordinate of theta"),
        numbers("own_gradient", "the own program's gradient, by coordinate of theta"),
    )

    timed_calls: int = param(5, "calls timed for costs and for gradients", positive=True)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: differences at w = 0, and times of costs and gradients [s].

        ``state_difference`` is the largest difference over time and coordinates, in the units of the coordinate.
        ``state_difference_rel`` is in units of the coordinate's largest value. Two engines are compared where the scene has
        no program of its own; ``reason`` has the step in which they part. Raises :class:`Unsupported` if the backend has no
        twin.
        """
        if "physics" not in cell.backend.provides:
            raise Unsupported(f"backend {cell.backend.name} has no twin to compare: its steps are the scene's own")
        able = cell.ranked_backends or capable_backends(cell.program())
        other = next((backend for backend in able if backend != cell.backend), None)
        if other is None:
            raise Unsupported(f"no backend but {cell.backend.name} runs this program")
        twin, own = session.problem(cell), session.problems.of(other, cell)
        theta, still = twin.program.theta0, np.zeros((twin.program.n_noise, 1))
        path, own_path = (problem.trajectory(theta, still).states[:, :, 0] for problem in (twin, own))
        gradient, own_gradient = (problem.grad() for problem in (twin, own))
        cost, own_cost = (float(problem.value()) for problem in (twin, own))
        differences, w = np.abs(path - own_path), first_batch(cell, len(still))
        relative = (differences / np.maximum(np.abs(own_path).max(axis=0), 1e-300)).max(axis=1)
        has_parted = not cell.ranked_backends and relative.max() > PARTED
        return {
            **finite_status("the engine's rollout or its gradient is not finite", path, gradient),
            **({"reason": f"the engines part in step {np.argmax(relative > PARTED)}"} if has_parted else {}),
            "own_backend": other.name,
            "state_difference": float(differences.max()),
            "state_difference_rel": float(relative.max()),
            "cost": cost,
            "own_cost": own_cost,
            "cost_difference_rel": abs(cost - own_cost) / abs(own_cost),
            "gradient": gradient.tolist(),
            "own_gradient": own_gradient.tolist(),
            "gradient_norm": norm(gradient),
            "own_gradient_norm": norm(own_gradient),
            "gradient_difference_rel": relative_error(gradient, own_gradient),
            "gradient_cosine": float(gradient @ own_gradient / (norm(gradient) * norm(own_gradient))),
            "value_s": timing.timed(lambda _: twin.value(theta, w), self.timed_calls)[1].median_s,
            **gradient_seconds(twin, w, self.timed_calls),
            "trace_s": twin.usage.trace_s,
            "lower_s": twin.usage.lower_s,
        }

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the table with a line per scene and engine, and the chart of differences, the largest first."""
        from bench.report.shown import Shown

        shown = Shown(experiment, rows)
        cells = shown.cells(SHOWN, "engines compared with the scenes' own programs", NOTES)
        worst = shown.good.groupby("problem")["gradient_difference_rel"].transform("max")
        frame = shown.good.loc[(-worst).sort_values(kind="stable").index]
        chart = Chart(
            "twins",
            frame,
            [
                shown.column(name, least=FLOOR, log=True, label=self.columns.by_name[name].doc)
                for name in ("gradient_difference_rel", "state_difference_rel", "cost_difference_rel")
            ],
            [text("problem", label="")],
            "dots",
            series="method",
            marks=[Mark("rounding up to here", 1e-6)],
        )
        return Views([cells], [chart])
