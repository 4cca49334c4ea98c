"""Measures how far trainers bring a neural policy, by steps and by seconds, with a log of the gradient on the way."""

from __future__ import annotations

from dataclasses import dataclass

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, bounded, numbers, seconds, several, text
from bench.model import Trainer, param
from bench.model.policy import PolicyScene
from bench.model.trainer import LOGGED

from .. import PARTS, StudyPackage

STARTS = "its 95% interval over starts"


@dataclass(frozen=True)
class Train(StudyPackage):
    """Trains a policy with each trainer and seed; records returns along the run and a log of every update."""

    name = "train"
    axes = (*PARTS, "trainer")
    timed = True
    descends = False
    columns = Columns.of(
        text("trainer", "identity string of the trainer"),
        Column("first_return", "mean return of the deterministic policy before the first update"),
        *bounded(
            "final_return",
            "mean return of the deterministic policy after the last update",
            of=STARTS,
            digits=3,
            log=False,
            comparison=ComparisonRule("interval", "final return", neutral=True),
        ),
        Column("final_median", "median return over starts after the last update", digits=3, log=False),
        Column("updates", "updates of the run"),
        Column("steps", "control steps of the run, over all rollouts", "steps"),
        seconds("train_s", "time of the updates, without compilation and evaluations", "training"),
        seconds("compile_s", "time of compiling start, update and evaluation", "compilation"),
        Column("gradient_typical", "median norm of the actor's gradient over updates", label="gradient norm"),
        Column("gradient_peak", "largest norm of the actor's gradient over updates", label="largest gradient"),
        Column(
            "window_gradient",
            "norm of the gradient of whole episodes that is cut into windows, each of which ends in the "
            "critic's value, halfway through the run",
        ),
        *bounded(
            "window_bias",
            "bias of that gradient: its distance from the gradient without cuts, relative to the latter",
            of="its 95% interval over independent batches of rollouts",
            label="bias of the windows",
        ),
        numbers(
            "slope_errors",
            "relative error of the gradient along which an update moves, in a random direction in each array of the "
            "actor (weights by layer, biases by layer, log deviation), halfway in float64; NaN: not known",
            table=False,
        ),
        Column("gradient_zero", "share of updates with a gradient of exactly 0"),
        numbers("curve_update", "updates at which the policy was evaluated", table=False),
        numbers("curve_step", "control steps up to those updates", table=False),
        numbers("curve_s", "time up to those updates", "s", table=False, measured=True),
        *bounded(
            "curve_return",
            "mean return of the deterministic policy there",
            of=STARTS,
            kind=numbers,
            has_csv=False,
            table=False,
        ),
        *several(
            numbers,
            {
                "cosine_update": "updates at which first- and zeroth-order gradients were compared",
                "cosine": "cosine between both gradients there",
                "cosine_denoised": "the same without noise, NaN where the noise is larger than a gradient",
                "log_update": "last update of each entry of the log",
            }
            | {f"log_{name}": meaning for name, meaning in LOGGED.items()},
            table=False,
        ),
    )

    starts: int = param(256, "starts of an evaluation, the same for all trainers and seeds", low=2)
    evaluations: int = param(20, "evaluations along a run, besides the first", positive=True)
    cosines: int = param(4, "comparisons of first- with zeroth-order gradients along a run", low=0)
    copies: int = param(16, "rollouts from each start in such a comparison", low=4)
    batches: int = param(
        16,
        "independent batches of rollouts that measure the bias of windows; 0: not measured",
        low=0,
    )
    entries: int = param(
        250, "most entries of a stored log; an entry is the mean or largest value of its updates", low=10
    )

    def refusal(self, cell: Cell) -> str | None:
        """Return why a policy cannot be trained in a cell, or None."""
        if not isinstance(cell.parts["trainer"], Trainer):
            return "a trainer is needed: see `python -m bench list trainers`"
        if not isinstance(cell.scene, PolicyScene):
            return f"scene {cell.scene.name} has no observations, from which a policy acts: choose a policy scene"
        if not hasattr(cell.backend, "ops"):
            return f"backend {cell.backend.name} does not run programs in JAX, which trainers do"
        return None
