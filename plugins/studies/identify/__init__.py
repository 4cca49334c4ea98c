"""Measures which parameters are identifiable from a record of the motion, how precisely, and whether fits reach that."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bench.errors import UserError
from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, bounded, exact, numbers, several, text
from bench.model import Decision, Identified, MechanicalScene, Optimizer, param

from .. import PARTS, StudyPackage

START = "start."
"""Prefix of entries of the initial state in theta."""


@dataclass(frozen=True)
class Identify(StudyPackage):
    """Fits parameters of a scene to noisy records of its motion, and compares the fits with the Cramer-Rao bound."""

    name = "identify"
    axes = (*PARTS, "optimizer")
    default_plugins = {"optimizers": ("gauss_newton",)}
    columns = Columns.of(
        text("optimizer", "identity string of the optimizer"),
        Column("rank", "directions of the parameters that the record sees"),
        exact(
            "condition", "largest singular value of the information over the smallest that is seen", "condition number"
        ),
        Column("fits", "records that were fitted"),
        Column("step_shift", "largest relative change of an estimate when the model's step is halved, without noise"),
        Column("step_shift_bound", "the same in units of the Cramer-Rao bound"),
        Column(
            "explained",
            "share of records that no test of the residuals contradicts, at 5% false alarms",
            label="explained",
            format="percent",
        ),
        text("contradictions", "tests that the first record's fit fails, each with its statistic in units of its edge"),
        Column("noise_size", "standard deviation of the residuals of the first record", "m"),
        text(
            "interval_noise",
            "noise that the first record's intervals allow for: of stated size, own size (that of the residuals), or "
            "correlated; empty: not all products are identifiable",
        ),
        numbers(
            "parameter", "identifiable products of powers of the unknowns, then unknowns that are not identifiable"
        ),
        numbers("estimate", "estimate of the first record by single shooting; nan: not identifiable", digits=4),
        *(numbers(f"estimate_{end}", f"{end} end of its 95% interval", digits=4, label=end) for end in ("low", "high")),
        numbers("unit", "its unit"),
        numbers("start", "value where its fit starts", format="setting"),
        numbers("identifiable", "yes, product (in products only), or no", label="seen"),
        numbers("bias", "the largest bias that a missing term causes while 5% of records do not show it"),
        numbers(
            "biased",
            "identifiable products, each with every term that the model lacks and whose effect is tested",
            label="parameter",
        ),
        numbers("term", "the term"),
        numbers("unnoticed", "the largest bias that it causes while 5% of records do not show it", label="unseen bias"),
        numbers("errors", "this bias in standard errors", label="in standard errors"),
        *several(
            numbers,
            {
                "unknowns": "names of the parameters",
                "truth": "true values of the parameters; nan: a record of your own",
                "invariants": "identifiable products of powers of the parameters",
                "bound": "Cramer-Rao bound of the relative standard deviation of each invariant",
                "shooting": "the shooting methods: single, multiple, windows",
                "optimum": "by shooting method, share of fits whose optimizer has reached an optimum",
            },
        ),
        *bounded(
            "converged",
            "by shooting method, share of fits whose residuals are consistent with the noise",
            kind=numbers,
            label="share of fits that converge",
        ),
        numbers(
            "error",
            "by shooting method, root mean square error of converged fits in units of the bound",
            label="error / Cramer-Rao bound",
            low="error_low",
            high="error_high",
        ),
        *bounded(
            "coverage",
            "by shooting method, share of 95% intervals of converged fits that contain the truth",
            kind=numbers,
            of="its 95% interval over records",
            label="coverage of 95% intervals",
        ),
        numbers("hidden", "by shooting method, fits with more identifiable directions than the record has"),
    )

    revision = 3

    measurement: float | None = param(
        None,
        "standard deviation of the noise on each measurement; null: 0.01, and for a record of your own estimated",
        "m",
        positive=True,
    )
    start: float = param(1.2, "fits start at this many times the truth, every second one at its inverse", positive=True)
    windows: int = param(8, "windows of multiple shooting and of windows", low=2)
    iterations: int = param(40, "steps of the optimizer", positive=True)
    refine: int = param(1, "the records come from a step this many times shorter", positive=True)
    record: str | None = param(
        None, "CSV file with measurements of your own, a line per step; null: made from the truth"
    )
    measured: str | None = param(
        None, "what its columns measure, {q0: angle*pi/180, v0: rate}; null: all columns, in order"
    )
    time: str | None = param(None, "its time in s, an expression too, with which lines may be missing; null: all steps")
    interpolate: bool = param(False, "interpolate it linearly at the steps")
    state: str | None = param(None, "initial state of the motion, {q0: 60*pi/180, v0: 1}; null: the scene's")
    terms: str | None = param(None, "accelerations that the model may lack, {name: v*q**2, other: sign(v)*abs(q1)}")

    descends = False

    def decision(self, given: Decision) -> Decision:
        """Return theta without entries of the initial state, such as start.q0."""
        return replace(given, names=tuple(name for name in given.names if not name.startswith(START)))

    def refusal(self, cell: Cell) -> str | None:
        """Return why a cell cannot be fitted (no motion, no unknowns, no NumPy steps, sampling, unusable data), or None."""
        scene, optimizer = cell.scene, cell.parts["optimizer"]
        assert isinstance(optimizer, Optimizer)
        if not isinstance(scene, MechanicalScene):
            return f"scene {scene.name} is a plain function: it has no motion to record"
        if not self.decision(cell.decision).names and not isinstance(scene, Identified):
            return f"scene {scene.name} names no unknowns: name parameters of it, theta=[..]"
        program = cell.program()
        if program.needs:
            integrator = cell.integrator.name if cell.integrator else "none"
            return (
                f"scene {scene.name} with integrator {integrator} cannot be stepped in NumPy, where records are fitted"
            )
        if optimizer.draws(2):
            return f"optimizer {optimizer.name} samples, and fits are compared along one path: use a deterministic one"
        try:
            self._module("measure").prepared(cell, self)
        except (OSError, ValueError, UserError) as error:
            return str(error).strip()
        return None
