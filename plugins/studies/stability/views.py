"""What the stability map shows: where the gradient is right, wrong or lost over step size and stiffness, and why."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.problems import axes_of, problem_names, titled
from bench.report.shown import PROBLEM
from bench.report.views import arrange, attempted

LEVEL = {"ok": "right", "inaccurate": "wrong", "wrong_sign": "wrong", "zero": "wrong", "diverged": "diverged",
         "nonfinite": "diverged", "unresolved": "open"}  # fmt: skip
"""The colour of each verdict."""
LOOKS = {
    "diverged": Style("#3b3b3b", meaning="diverged: the state, or the gradient is not finite"),
    "wrong": Style(
        "#e69f00", meaning="wrong: finite, but off by more than the limit of the study, of wrong sign or zero"
    ),
    "open": Style("#f2f2f2", meaning="open: the truth is not resolved"),
    "right": Style("#a6d8f5", meaning="right: within that limit of the truth"),
}
"""Looks of the colours, the worst first."""
CAUSES = ("step", "law", "both", "unknown")
BEYOND = "•"
"""Mark of a cell whose stiffness is above the step's limit in theory."""
MIXED = 0.05, 0.95
"""Shares of right cells between which a law with an integrator is drawn, with its other integrators."""
RESULTS = (
    "verdict", "cause", "relative_error", "cosine", "spectral_radius", "stiffness_limit", "first_bad_step", "truth",
)  # fmt: skip
SHARES = (
    text("scene"), text("step", label="law and integrator"), Column("cells", format="setting"),
    *(Column(name, format="percent") for name in ("right", "wrong", "diverged", "open")),
    *(Column(f"by {cause}", label=f"wrong by {cause}", format="percent") for cause in CAUSES),
)  # fmt: skip
SHARE_NOTES = (
    "wrong by step: the step or its derivative is wrong and the law is right. by law: wrong at any step. by both, by unknown: "
    "the cause is not resolved. Shares are of the cells.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables of shares and of cells, and the map; None without any."""
    cells = cells_of(experiment, rows)
    if cells.empty:
        return None
    whole = Table("stability_map", table(experiment, rows), [], files=["csv"])
    shares = Table("stability_shares", shares_of(cells), SHARES, "How often each contact law and step gives the right gradient",
                   SHARE_NOTES, terminal=True, page=True)  # fmt: skip
    columns = [experiment.columns.by_name[name] for name in RESULTS]
    return Views([shares, whole], [chart(cells)], arrange(experiment, rows).rows, columns)


def cells_of(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the cells with a verdict, with their stored step size and stiffness, names, colour and mark."""
    shown = arrange(experiment, rows)
    # labels keep apart what differs in another stiffness, such as the scene's own
    shown = replace(shown, rows=shown.rows.assign(dt=rows["dt"], stiffness=rows["stiffness"]))
    cells = attempted(shown.rows)
    cells = cells[cells["verdict"] != ""]
    return cells.assign(
        problem=problem_names(shown, PROBLEM, axes_of(shown, "dt", "stiffness"), rows=cells), row=cells.index,
        level=cells["verdict"].map(LEVEL).fillna("open"), place=titled(cells, ["scene", "contact"]),
        step=titled(cells, ["contact", "integrator"]), scene_name=rows.loc[cells.index, "scene"].str.split("[").str[0],
        mark=np.where(cells["stiffness"] > cells["stiffness_limit"], BEYOND, ""),
    )  # fmt: skip


def shares_of(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the share of each colour and cause by scene, contact law and integrator, the best of each scene first."""
    cause = cells["cause"].where(cells["cause"].isin(CAUSES), "unknown").where(cells["level"] == "wrong", "")
    groups = [cells["scene_name"].rename("scene"), cells["step"]]
    level, why = (pd.crosstab(groups, values, normalize="index") for values in (cells["level"], "by " + cause))
    counts = cells.groupby(groups, sort=False).size().rename("cells")
    shares = pd.concat([counts, level, why], axis=1).loc[counts.index]
    shares = shares.reindex(columns=[column.name for column in SHARES[2:]], fill_value=0.0).reset_index()
    order = list(dict.fromkeys(cells["scene_name"]))
    return shares.sort_values("right", ascending=False, kind="stable").sort_values(
        "scene", key=lambda names: names.map(order.index), kind="stable", ignore_index=True
    )


def chart(cells: pd.DataFrame) -> Chart:
    """Return the map of the first variant of each scene, law and integrator."""
    missing = cells["stiffness"].isna()  # a law without stiffness is the same at each one
    levels = pd.DataFrame({"stiffness": sorted(cells["stiffness"].dropna().unique()) or [math.nan]})
    spread = cells[missing].drop(columns="stiffness").merge(levels, how="cross")
    frame = pd.concat([cells[~missing], spread], ignore_index=True)
    frame = frame.sort_values("level", key=lambda names: names.map(list(LOOKS).index), kind="stable")
    frame = frame.drop_duplicates(["problem", "dt", "stiffness"]).sort_index()
    frame = frame[frame["problem"] == frame.groupby(["integrator", "place"], sort=False)["problem"].transform("first")]
    right = (frame["level"] == "right").groupby([frame["integrator"], frame["place"]]).transform("mean")
    mixed = frame["place"].isin(frame["place"][right.between(*MIXED)])
    frame = frame[mixed] if mixed.any() else frame
    places = frame["place"].unique()
    which = f"{places[0]}; " if len(places) == 1 else ""
    frame["panel"] = frame["integrator"] if which else frame["place"] + ", " + frame["integrator"]
    dt, stiffness = replace(COMMON["dt"], label="time step"), COMMON["stiffness"]
    return Chart(
        "stability_map", frame, [dt], [stiffness], "grid", level="level", styles=LOOKS, panel="panel",
        cell="mark", height=0.16, subtitle=f"{which}{BEYOND} beyond the stability limit in theory",
        text="The worst verdict where backends disagree. Scenes and laws that are right everywhere or nowhere are in the table only.",
    )  # fmt: skip
