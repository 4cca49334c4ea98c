"""Builds the page of searches: quality against runtime, regret along the paths, and scores by learning rate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.style import PALETTE
from bench.report.web.content import (
    STATUS,
    SYMBOLS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    look,
    no_result_sentence,
)
from bench.studies.optimise import aggregate, findings
from bench.studies.optimise.report import default_ratio, looks, methods

RESULTS = [
    TableColumn("method", "method", "text"), TableColumn("stopped", "stopped", "text"), TableColumn("scene_class", "class", "text"),
    TableColumn("final_cost", "final cost"), TableColumn("best_known", "J*"), TableColumn("score", "score"), TableColumn("rollouts", "rollouts"),
    TableColumn("gradients", "gradients"), TableColumn("search_s", "search", "seconds"),
    TableColumn("quality_rmse_rel", "gradient's error, relative"), TableColumn("quality_bias_share", "share of bias"),
]  # fmt: skip
CLASS_COLOURS = dict(
    zip(("smooth", "stiff", "discontinuous", "chaotic", "identification"), (PALETTE[0], PALETTE[2], PALETTE[3], PALETTE[4], PALETTE[5]), strict=True)
)  # fmt: skip


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the findings, the charts and the table of searches."""
    runs, default = aggregate.collect_runs(experiment, rows), default_ratio(experiment)
    if not len(runs.rows):
        return Content(no_result_sentence(rows), rows, [*identity_columns(rows), *STATUS], [])
    table = rows.assign(**{name: runs.rows[name] for name in ("problem", "method", "tuning", "best_known", "score")})
    table["score"], table["best_known"] = table["score"].astype(float), table["best_known"].astype(float)
    table = table.fillna({"problem": "", "method": "", "tuning": ""}).assign(series=lambda t: t["method"])
    points = aggregate.quality_and_runtime(runs, default).assign(series=lambda t: t["scene_class"] if len(t) else [])
    position = {index: place for place, index in enumerate(rows.index)}
    first = {(p, m): position[part.index[0]] for p, m, part in runs.by_method()}
    if len(points):
        points["row"] = [first[key] for key in zip(points["problem"], points["method"], strict=True)]
        points["art"] = points["art"].replace(np.inf, np.nan)
    charts = []
    if len(points):
        charts.append(Chart(
            "Does the better gradient reach the target sooner?",
            "A point per problem and method: average runtime to a tenth of the first regret against the relative error of a gradient at the start. Methods that never reach the target have no point.",
            [PlotAxis("rmse_rel", "relative error of a gradient at the start"), PlotAxis("bias_share", "share of bias", False), PlotAxis("cosine", "cosine", False)],
            [PlotAxis("art", "average runtime [rollouts]")], table="quality",
        ))  # fmt: skip
    charts.append(Chart(
        "Regret along the path", "Each method at its best tuning: median over seeds, 20% to 80%.",
        [PlotAxis("spent", "rollouts, a gradient at its time")], [PlotAxis("regret", "J - J*", True, "low", "high")], table="paths",
        facet="problem", line="series",
    ))  # fmt: skip
    tuned = aggregate.scores_by_tuning(runs)
    tuned = tuned.assign(
        series=tuned["method"],
        row=[first.get((p, m), 0) for p, m in zip(tuned["problem"], tuned["method"], strict=True)],
    )
    if len(tuned):
        charts.append(Chart(
            "How much does tuning alone change the score?", "Median score over seeds, 20% to 80%.",
            [PlotAxis("value", "tuned parameter")], [PlotAxis("score", "score", False, "low", "high")], table="rates",
            facet="problem", line="series",
        ))  # fmt: skip
    return Content(
        finding="; ".join(sentence.rstrip(".").replace("; ", ", ") for sentence in findings.sentences(runs, default)),
        rows=table,
        columns=[*identity_columns(table, [axis.column for axis in runs.tuned_axes]), *RESULTS, *STATUS],
        charts=charts,
        answers=methods(aggregate.summarise(runs, default)),
        answers_title="Scores of the methods",
        tables={"quality": points, "paths": _paths(runs, default, first), "rates": tuned},
        looks={**_looks(runs), **{name: look(shade) for name, shade in CLASS_COLOURS.items()}},
    )


def _looks(runs: aggregate.RunSet) -> dict[str, dict[str, Any]]:
    """Return the look of each method, with the figures' colours and markers; methods that use only costs are dashed."""
    return {
        name: look(style["color"], SYMBOLS[style["marker"]], "solid" if ", " in name else "dash")
        for name, style in looks(runs.methods).items()
    }


def _paths(runs: aggregate.RunSet, default: float, first: dict[tuple[str, str], int]) -> pd.DataFrame:
    lines = []
    for problem, method, part in runs.by_method():
        ratio = runs.gradient_ratio(problem, default)
        places = [aggregate.rollouts_spent(row, ratio) for _, row in part.iterrows()]
        ends = [place for place in places if len(place) > 1 and place[-1] > 0]
        if not ends:
            continue
        grid = np.geomspace(max(min(place[1] for place in ends), 1.0), max(place[-1] for place in ends), 40)
        for x, low, middle, high in zip(grid, *aggregate.regret_quantiles(part, places, grid), strict=True):
            line = {"row": first[problem, method], "problem": problem, "series": method, "spent": x}
            lines.append(line | {"regret": middle, "low": low, "high": high})
    return pd.DataFrame(lines, columns=["row", "problem", "series", "spent", "regret", "low", "high"]).replace(
        np.inf, np.nan
    )
