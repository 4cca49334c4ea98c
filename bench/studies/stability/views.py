"""What the stability map shows: where the gradient is right, wrong or lost over step size and stiffness, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.problems import axes_of
from bench.report.views import attempted
from bench.report.writer import reasons
from bench.studies.stability.maps import (
    LOST,
    PLACES,
    VERDICTS,
    WRONG,
    Panel,
    arrange_maps,
    label_columns_of,
    limits_of,
    meaning,
    panels,
    unstable,
    with_verdict,
)

CLASSES = {"right": ("ok",), "wrong": WRONG, "diverged": LOST, "open": ("unresolved",)}
"""Verdicts of each colour, the best first."""
CAUSES = ("step", "law", "both", "unknown")
COLOURS = {"right": "#a6d8f5", "wrong": "#e69f00", "diverged": "#3b3b3b", "open": "#f2f2f2"}
BEYOND = "•"
"""Mark of a cell whose stiffness is above the step's limit in theory."""
RESULTS = (
    "verdict",
    "cause",
    "relative_error",
    "cosine",
    "spectral_radius",
    "stiffness_limit",
    "first_bad_step",
    "truth",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of shares and of stability limits, and the maps."""
    shown = arrange_maps(experiment, rows)
    maps = panels(shown)
    whole = Table(
        "stability_map", *_maps(maps, label_columns_of(shown, axes_of(shown, *PLACES))), data=table(experiment, rows),
        title="shares of verdicts and stability limits", notes=notes(shown.rows),
    )  # fmt: skip
    cells = _cells(maps)
    if cells.empty:
        return Views([whole], remarks=reasons(rows))
    shares = shares_of(cells)
    answers = Table(
        "stability_shares", shares,
        [text("scene"), text("step", label="law and integrator"), Column("cells", format="setting"),
         *(Column(name, format="percent") for name in CLASSES),
         *(Column(f"by {cause}", label=f"wrong by {cause}", format="percent") for cause in CAUSES)],
        title="How often each contact law and step gives the right gradient", notes=notes(shown.rows)[:2], terminal=True,
        page=True,
    )  # fmt: skip
    return Views(
        [answers, whole], charts(cells, shown.rows), shown.rows,
        [experiment.columns.by_name[name] for name in RESULTS], reasons(rows),
    )  # fmt: skip


def notes(rows: pd.DataFrame) -> list[str]:
    """Return explanations of the tables, with the limits of the rows' studies."""
    return [
        "; ".join(f"{name}: {meaning(name, rows)}" for name in VERDICTS) + ".",
        "wrong by step: the step or its derivative is wrong and the law is right. by law: wrong at any step. by both, by "
        "unknown: the cause is not resolved. Shares are of the cells.",
        "unstable: diverged, or, without contact, a state that grows by more than 1e-9 per step and would diverge at a longer "
        "horizon, whatever the verdict on the gradient at this one.",
        "theory: stiffness at which the step's spectral radius on the oscillator exceeds 1, at that dt. A contact is an "
        "oscillator while it lasts. measured: the largest stiffness below the first unstable one, and that one. agree: step "
        "sizes at which theory and measurement are within one cell of the grid.",
    ]


# ------------------------------------------------------------------------------------------------------- tables


def _maps(maps: Sequence[Panel], labels: Sequence[str]) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per map with the shares of the verdicts and both stability limits, and the columns for readers."""
    lines = []
    for panel in maps:
        cells = attempted(panel.rows)
        given = {"integrator": panel.integrator, "scene": panel.scene, "contact": panel.contact, **panel.values}
        shares = {name: float((cells["verdict"] == name).mean()) for name in VERDICTS}
        limits = dict(zip(("at dt", "theory", "measured", "agree"), limits_of(panel), strict=True))
        lines.append(given | {"backends": ", ".join(panel.backends), "cells": len(cells)} | shares
                     | {"unstable": float(unstable(cells).mean())} | limits)  # fmt: skip
    columns = [
        *(COMMON[name] for name in ("integrator", "scene", "contact")), *map(text, labels), text("backends"),
        Column("cells", format="setting"), *(Column(name, format="percent") for name in (*VERDICTS, "unstable")),
        *map(text, ("at dt", "theory", "measured", "agree")),
    ]  # fmt: skip
    return pd.DataFrame(lines, columns=[column.name for column in columns]), columns


def _cells(maps: Sequence[Panel]) -> pd.DataFrame:
    """Return a row per cell with a verdict, with its map's names, its class and whether theory says it is unstable."""
    parts = [
        with_verdict(panel.rows).assign(
            step=", ".join(name for name in (panel.contact, panel.integrator) if name != "none"), scene_name=panel.kind[1],
            problem=panel.problem, variant=panel.variant, title=panel.title,
        )
        for panel in maps
    ]  # fmt: skip
    cells = pd.concat(parts) if parts else pd.DataFrame(columns=["verdict", "stiffness", "stiffness_limit"])
    classes = {verdict: name for name, verdicts in CLASSES.items() for verdict in verdicts}
    beyond = cells["stiffness"] > cells["stiffness_limit"]
    return cells.assign(
        row=cells.index, level=cells["verdict"].map(classes).fillna("open"), mark=beyond.map({True: BEYOND, False: ""})
    )


def shares_of(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the share of each class and cause by scene, contact law and integrator, the best of each scene first.

    Scenes are grouped by name. Names of laws and integrators contain the parameters that distinguish them.
    """
    cause = cells["cause"].where(cells["cause"].isin(CAUSES), "unknown").where(cells["level"] == "wrong", "")
    groups = cells.assign(cause=cause).groupby(["scene_name", "step"], sort=False)
    lines = [
        {"scene": scene, "step": step, "cells": len(part)}
        | {name: float((part["level"] == name).mean()) for name in CLASSES}
        | {f"by {cause}": float((part["cause"] == cause).mean()) for cause in CAUSES}
        for (scene, step), part in groups
    ]
    order = {scene: place for place, scene in enumerate(cells["scene_name"].unique())}
    return (
        pd.DataFrame(lines)
        .sort_values("right", ascending=False, kind="stable")
        .sort_values("scene", key=lambda names: names.map(order), kind="stable")
        .reset_index(drop=True)
    )


# ------------------------------------------------------------------------------------------------------- charts


def charts(cells: pd.DataFrame, rows: pd.DataFrame) -> list[Chart]:
    """Return the maps of the first variant of each problem, all maps for the page, and the shares of right gradients."""
    frame = _without_gaps(cells)
    worst = {name: place for place, name in enumerate(("diverged", "wrong", "open", "right"))}
    frame = frame.sort_values("level", key=lambda names: names.map(worst), kind="stable")
    frame = frame.drop_duplicates(["integrator", "title", *PLACES]).sort_index()
    first = frame.groupby(["integrator", "problem"], sort=False)["variant"].transform("first")
    styles = {
        name: Style(COLOURS[name], meaning=_meaning(name, rows)) for name in CLASSES if name in set(frame["level"])
    }
    dt, stiffness = (replace(COMMON[name], label={"dt": "time step"}.get(name, "")) for name in PLACES)
    shared: dict[str, Any] = {"kind": "grid", "level": "level", "styles": styles}
    variants = list(dict.fromkeys(frame.loc[frame["variant"] == first, "variant"]))
    more = " The other values are on the page." if frame["variant"].nunique() > len(variants) else ""
    printed = Chart(
        "stability_map", frame[frame["variant"] == first], [dt], [stiffness], panel="problem", panel_row="integrator", cell="mark",
        height=0.085, subtitle=f"{BEYOND} beyond the stability limit in theory. Blank: not supported."
        + (f" At {' and '.join(filter(None, variants))}.{more}" if any(variants) else ""),
        text="The worse verdict where backends disagree. Verdicts and causes can be chosen in the filters.", **shared,
    )  # fmt: skip
    frame = frame.assign(panel=frame["title"] + ", " + frame["integrator"])
    every = Chart(
        "stability_maps", frame, [dt], [stiffness], panel="panel", printed=False,
        text="Verdicts and causes can be chosen in the filters.", **shared,
    )  # fmt: skip
    return [printed, *([every] if frame["variant"].nunique() > 1 else []), _share_chart(cells)]


def _meaning(name: str, rows: pd.DataFrame) -> str:
    limit = meaning("ok", rows)
    return {
        "right": f"right: {limit}", "wrong": "wrong: finite, but further off, of wrong sign or zero",
        "diverged": "diverged: the state, or the gradient is not finite", "open": "open: the truth is not resolved",
    }[name]  # fmt: skip


def _without_gaps(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the cells, those without a stiffness repeated at every stiffness of the grid."""
    levels = sorted(cells["stiffness"].dropna().unique()) or [math.nan]
    missing = cells["stiffness"].isna()
    spread = cells[missing].drop(columns="stiffness").merge(pd.DataFrame({"stiffness": levels}), how="cross")
    return pd.concat([cells[~missing], spread], ignore_index=True)


def _share_chart(cells: pd.DataFrame) -> Chart:
    """Return the share of right gradients by problem and integrator."""
    right = (cells["level"] == "right").groupby([cells["problem"], cells["integrator"]], sort=False).mean()
    frame = right.rename("share").reset_index()
    return Chart(
        "stability_shares", frame.assign(cell=[f"{v:.0%}" for v in frame["share"]]),
        [COMMON["integrator"]], [text("problem")], "grid", value="share", cell="cell", printed=False,
        text="Share of step sizes and stiffnesses, over all values of the other parameters.",
    )  # fmt: skip
