"""The page of the stability map: the share of right gradients of each step, and the maps."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from bench.grid import Experiment
from bench.report.stability import VERDICTS
from bench.report.views import ran
from bench.report.web.content import (
    STATUS,
    Axis,
    Chart,
    Column,
    Content,
    counted,
    identity_columns,
    look,
    titled,
)

RESULTS = [
    Column("verdict", "verdict", "text"),
    Column("relative_error", "rel. error"),
    Column("cosine", "cosine"),
    Column("spectral_radius", "spectral radius"),
    Column("stiffness_limit", "stiffness limit"),
    Column("first_bad_step", "first bad step"),
    Column("truth", "truth", "text"),
]


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """The step that is right most often, shares, and maps over step size and stiffness."""
    made = rows.assign(
        problem=titled(rows, ["scene", "contact"]),
        panel=titled(rows, ["integrator", "scene", "contact"]),
        series=rows["verdict"],
    )
    share = Chart(
        "How often is the gradient right?",
        "Share of step sizes and stiffnesses at which the gradient is within 10% of the truth.",
        [Axis("integrator", "integrator")],
        [Axis("problem", "problem")],
        level="verdict",
        share="ok",
    )
    maps = Chart(
        "Where is it right?",
        "The verdict at every step size and stiffness; the worse one where backends disagree.",
        [Axis("dt", "time step [s]")],
        [Axis("stiffness", "stiffness [N/m]")],
        facet="panel",
        level="verdict",
    )
    return Content(
        finding="No cell has a verdict: the table has the reason of each."
        if (rows["verdict"] == "").all()
        else finding(rows),
        rows=made,
        columns=[*identity_columns(rows), *RESULTS, *STATUS],
        charts=[share, maps],
        answers=answers(rows),
        answers_title="How often each contact law and step gives the right gradient",
        looks={
            name: look(colour, letter=letter, meaning=f"{name}: {meaning}")
            for name, (letter, colour, meaning) in VERDICTS.items()
            if name
        },
    )


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """By scene, contact law and integrator the share of each verdict among the cells that ran, the best of a scene first."""
    known = ran(rows)
    known = known[known["verdict"] != ""]
    step = titled(known, ["contact", "integrator"])
    scene = [text.partition("[")[0] for text in known["scene"]]
    found = pd.crosstab([scene, step], known["verdict"], normalize="index")
    found = found.reindex(columns=[name for name in VERDICTS if name], fill_value=0.0).rename_axis(["scene", "step"])
    return found.reset_index().sort_values(["scene", "ok"], ascending=[True, False], kind="stable")


def finding(rows: pd.DataFrame) -> str:
    """Of each scene the step that is right most often; how often a gradient is wrong without a sign of it."""
    found = shares(rows)
    parts = []
    for scene, part in found.groupby("scene", sort=False):
        first, last = part.iloc[0], part.iloc[-1]
        least = f", least with {last['step']} ({last['ok']:.0%})" if len(part) > 1 else ""
        parts.append(f"{scene}: right most often with {first['step']} ({first['ok']:.0%} of its cells){least}")
    known = ran(rows)
    silent = int(known["verdict"].isin(("inaccurate", "wrong_sign", "zero")).sum())
    lost = int(known["verdict"].isin(("diverged", "nonfinite")).sum())
    head = f"{silent} of {counted(len(known), 'cell')} have a finite but wrong gradient, {lost} a state that diverges"
    return "; ".join([head, *parts]) + "."


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Shares as texts."""
    if (rows["verdict"] == "").all():
        return pd.DataFrame()
    found = shares(rows)
    texts = {name: [f"{share:.0%}" if share else "-" for share in found[name]] for name in VERDICTS if name}
    return found.assign(**texts)
