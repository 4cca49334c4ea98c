"""Says how far each backend has come on the ladder of an experiment's scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.experiment.experiment import Experiment
from bench.experiment.study import Study, study_of
from bench.report.text import counted, listed
from bench.run.ladder import fault_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Climb:
    """How far a backend has come."""

    passed: tuple[str, ...]
    """The rungs that passed, the lowest first."""
    stop: str
    """The rung that did not pass; empty if all passed."""
    reason: str
    above: tuple[str, ...]
    """The rungs above it."""


def findings(experiment: Experiment, rows: pd.DataFrame) -> list[str]:
    """Return which rung each backend has reached and why it stopped, a sentence per outcome."""
    climbs: dict[Climb, list[str]] = {}
    for backend, part in rows.groupby("backend", sort=False):
        climbs.setdefault(_climb(study_of(experiment), part), []).append(str(backend))
    return [_sentence(climb, backends) for climb, backends in climbs.items()]


def _climb(study: Study, rows: pd.DataFrame) -> Climb:
    names = list(dict.fromkeys(rows["scene"]))
    for place, name in enumerate(names):
        if reason := fault_of(study, rows[rows["scene"] == name]):
            return Climb(tuple(names[:place]), name, reason, tuple(names[place + 1 :]))
    return Climb(tuple(names), "", "", ())


def _sentence(climb: Climb, backends: Sequence[str]) -> str:
    who = listed(backends)
    if not climb.stop:
        return f"All {counted(len(climb.passed), 'rung')} pass with {who}: {listed(climb.passed)}."
    reached = f"after {listed(climb.passed)} passed" if climb.passed else "at the lowest rung"
    are = "is" if len(climb.above) == 1 else "are"
    above = f", so {listed(climb.above)} above it {are} not started" if climb.above else ""
    rung = climb.stop if climb.above else f"the highest rung, {climb.stop}"
    return f"With {who} the climb stops at {rung}, {reached}: {climb.reason}{above}."
