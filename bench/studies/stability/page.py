"""The page of the stability map: the share of right gradients of each step, and the maps."""

from __future__ import annotations

import pandas as pd

from bench.experiment.axes import parsed
from bench.experiment.experiment import Experiment
from bench.report.text import counted
from bench.report.views import Arranged, attempted
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    look,
    problems,
    together,
)
from bench.studies.stability.report import LOST, PLACES, STEP, VERDICTS, meaning, name_of, placed

RESULTS = [
    TableColumn("verdict", "verdict", "text"),
    TableColumn("relative_error", "rel. error"),
    TableColumn("cosine", "cosine"),
    TableColumn("spectral_radius", "spectral radius"),
    TableColumn("stiffness_limit", "stiffness limit"),
    TableColumn("first_bad_step", "first bad step"),
    TableColumn("truth", "truth", "text"),
]


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the integrator that is right most often, shares, and maps over step size and stiffness."""
    shown = placed(experiment, rows)
    over = together(shown, *PLACES)
    judged = (rows["verdict"] != "").any()
    table = shown.rows.assign(
        problem=problems(shown, ["scene", "contact"], over, always=("scene", "contact")),
        panel=problems(shown, STEP, over, always=STEP),
        series=rows["verdict"],
    )
    share = Chart(
        "How often is the gradient right?",
        f"Share of step sizes and stiffnesses at which the gradient is {meaning('ok', rows)}.",
        [PlotAxis("integrator", "integrator")],
        [PlotAxis("problem", "problem")],
        level="verdict",
        share="ok",
    )
    maps = Chart(
        "Where is it right?",
        "The verdict at every step size and stiffness; the worse one where backends disagree.",
        [PlotAxis("dt", "time step [s]")],
        [PlotAxis("stiffness", "stiffness [N/m]")],
        facet="panel",
        level="verdict",
    )
    return Content(
        finding=finding(shown) if judged else "No cell has a verdict: the table has the reason of each.",
        rows=table,
        columns=[*identity_columns(table, [axis.column for axis in shown.axes]), *RESULTS, *STATUS],
        charts=[share, maps],
        answers=answers(shown) if judged else pd.DataFrame(),
        answers_title="How often each contact law and step gives the right gradient",
        looks={
            name: look(colour, letter=letter, meaning=f"{name}: {meaning(name, rows)}")
            for name, (letter, colour, _) in VERDICTS.items()
            if name
        },
    )


def shares(shown: Arranged) -> pd.DataFrame:
    """Return each verdict's share of the cells that ran, by scene, contact law and integrator, a scene's best first.

    Scenes are grouped by name; laws and integrators keep the parameters that distinguish them.
    """
    judged = attempted(shown.rows)
    judged = judged[judged["verdict"] != ""]
    step = problems(shown, ["contact", "integrator"], together(shown, *PLACES), ("contact", "integrator"), judged)
    scene = [name_of(given.get("scene")) for given in parsed(judged)]
    table = pd.crosstab([scene, step], judged["verdict"], normalize="index")
    table = table.reindex(columns=[name for name in VERDICTS if name], fill_value=0.0).rename_axis(["scene", "step"])
    return table.reset_index().sort_values(["scene", "ok"], ascending=[True, False], kind="stable")


def finding(shown: Arranged) -> str:
    """Write, per scene, the step that is right most often, and how often a gradient is wrong without a sign of it."""
    table = shares(shown)
    parts = []
    for scene, part in table.groupby("scene", sort=False):
        first, last = part.iloc[0], part.iloc[-1]
        least = f", least with {last['step']} ({last['ok']:.0%})" if len(part) > 1 else ""
        parts.append(f"{scene}: right most often with {first['step']} ({first['ok']:.0%} of its cells){least}")
    judged = attempted(shown.rows)
    silent = int(judged["verdict"].isin(("inaccurate", "wrong_sign", "zero")).sum())
    lost = int(judged["verdict"].isin(LOST).sum())
    head = f"{silent} of {counted(len(judged), 'cell')} have a finite but wrong gradient, {lost} a state that diverges"
    return "; ".join([head, *parts]) + "."


def answers(shown: Arranged) -> pd.DataFrame:
    """Return the shares as texts."""
    table = shares(shown)
    texts = {name: [f"{share:.0%}" if share else "-" for share in table[name]] for name in VERDICTS if name}
    return table.assign(**texts)
