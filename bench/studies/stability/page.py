"""Builds the page of the stability map: the share of right gradients by integrator, and the maps."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.report.problems import axes_of, problem_names
from bench.report.text import counted
from bench.report.views import Arranged, attempted
from bench.report.web.content import STATUS, Chart, Content, PlotAxis, TableColumn, identity_columns, look
from bench.studies.stability.report import (
    LOST,
    PLACES,
    STEP,
    VERDICTS,
    WRONG,
    arrange_maps,
    meaning,
    name_of,
    with_verdict,
)

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
    """Return the content of the page: the finding, the shares of right gradients, and the maps over dt and stiffness."""
    shown = arrange_maps(experiment, rows)
    over = axes_of(shown, *PLACES)
    has_verdict = (rows["verdict"] != "").any()
    table = shown.rows.assign(
        problem=problem_names(shown, ["scene", "contact"], over, always=("scene", "contact")),
        panel=problem_names(shown, STEP, over, always=STEP),
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
        finding=finding(shown) if has_verdict else "No cell has a verdict: the table has the reason of each.",
        rows=table,
        columns=[*identity_columns(table, [axis.column for axis in shown.axes]), *RESULTS, *STATUS],
        charts=[share, maps],
        answers=answers(shown) if has_verdict else pd.DataFrame(),
        answers_title="How often each contact law and step gives the right gradient",
        looks={
            name: look(colour, letter=letter, meaning=f"{name}: {meaning(name, rows)}")
            for name, (letter, colour, _) in VERDICTS.items()
            if name
        },
    )


def shares(shown: Arranged) -> pd.DataFrame:
    """Return each verdict's share of the cells by scene, contact law and integrator, the best of each scene first.

    Scenes are grouped by name. Names of laws and integrators contain the parameters that distinguish them.
    """
    cells = with_verdict(shown.rows)
    step = problem_names(shown, ["contact", "integrator"], axes_of(shown, *PLACES), ("contact", "integrator"), cells)
    scene = [name_of(given.get("scene")) for given in parse(cells)]
    table = pd.crosstab([scene, step], cells["verdict"], normalize="index")
    table = table.reindex(columns=[name for name in VERDICTS if name], fill_value=0.0).rename_axis(["scene", "step"])
    return table.reset_index().sort_values(["scene", "ok"], ascending=[True, False], kind="stable")


def finding(shown: Arranged) -> str:
    """Format how many gradients are finite but wrong, and the most and least reliable law and integrator on each scene."""
    table = shares(shown)
    parts = []
    for scene, part in table.groupby("scene", sort=False):
        first, last = part.iloc[0], part.iloc[-1]
        least = f", least often with {last['step']} ({last['ok']:.0%})" if len(part) > 1 else ""
        parts.append(f"{scene}: right most often with {first['step']} ({first['ok']:.0%} of its cells){least}")
    cells = attempted(shown.rows)
    n_wrong, n_lost = int(cells["verdict"].isin(WRONG).sum()), int(cells["verdict"].isin(LOST).sum())
    return (
        f"The gradient is finite but wrong in {n_wrong} of {counted(len(cells), 'cell')}, and the state diverges in "
        f"{n_lost}. {'; '.join(parts)}."
    )


def answers(shown: Arranged) -> pd.DataFrame:
    """Return the verdicts' shares as a table of strings."""
    table = shares(shown)
    texts = {name: [f"{share:.0%}" if share else "-" for share in table[name]] for name in VERDICTS if name}
    return table.assign(**texts)
