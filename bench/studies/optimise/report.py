"""Writes searches as tables and charts: quality against runtime, anytime curves, times to targets, learning rates."""

from __future__ import annotations

import math
import re
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.axes import table
from bench.experiment.experiment import Experiment
from bench.report.colours import ink, stamp
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.scales import log_axis
from bench.report.style import DEVIANT, MARKERS, VARIANTS, inches, plain, wrapped
from bench.report.tables import plain_markdown
from bench.report.text import counted, number
from bench.run.files import write_all
from bench.studies.optimise import aggregate, findings
from bench.studies.optimise.aggregate import RunSet

NOTES = (
    "score: share of the way from the first cost to J*, interquartile mean over searches, with a bootstrap interval "
    "stratified by problem. beats fobg: chance of a lower final cost, paired by problem and seed. profile: integral of the "
    "share of targets reached within 1 to 4 times the best method's runtime. aRT: average runtime in rollouts (a gradient "
    "counts as many as it takes the time of): all that the searches spent, over the number that arrived; inf if none did. "
    "Each method is shown at its best tuning on each problem, chosen by median final cost of {seeds}; the median "
    "score over all its tunings stands beside it, and their number is what the tuning cost. Methods that look at costs only "
    "(dashed in charts) are context: no gradient is judged by them.",
)

ACROSS = 4
"""Most panels side by side."""
TITLE = 1.6
"""Inches of a line of a panel's title."""
CONTEXT = tuple(zip(("#000000", "#8c8c8c", "#4d4d4d", "#b3b3b3"), (*VARIANTS[1:], *DEVIANT[:2]), strict=True))
"""Greys and dashes of methods that look at costs only."""
LETTERS = 92
"""Letters of a title's line."""
STEPS = 80
"""Points of a drawn curve; a marker stands on every fifth part of it."""
DEPTH = 1e-7
"""Regrets below this share of the largest are not drawn: one search reaches 0 where J* is the lowest cost of any."""


def notes(found: RunSet) -> list[str]:
    """Explain the columns, and say which seeds chose the tunings."""
    chosen = found.tuning_seeds
    seeds = (
        f"seeds {', '.join(map(str, chosen))}, which score nothing" if chosen else "the same seeds that it is scored on"
    )
    return [text.format(seeds=seeds) for text in NOTES]


def default_ratio(experiment: Experiment) -> float:
    """Return the rollouts that a gradient counts as where no times were measured."""
    return float(getattr(experiment.study, "gradient_cost", 4.0))


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``optimise`` (.csv, .md), ``targets.csv`` and ``summary.csv``, and the charts."""
    found, default = aggregate.races(experiment, rows), default_ratio(experiment)
    contents = {"optimise.csv": table(experiment, rows).to_csv(index=False, lineterminator="\n")}
    if not len(found.rows):
        contents["optimise.md"] = f"# {experiment.name}\n\nNo search gave a result.\n"
        return write_all(experiment.directory, contents)
    reached, summed = aggregate.targets(found, default), aggregate.summary(found, default)
    contents["targets.csv"] = reached.to_csv(index=False, lineterminator="\n")
    contents["summary.csv"] = summed.to_csv(index=False, lineterminator="\n")
    texts = [f"# {experiment.name}: does a better gradient get there sooner?", *findings.sentences(found, default)]
    texts += ["## Methods", plain_markdown(methods(summed)), "## Times to targets", plain_markdown(arrivals(reached))]
    texts += ["## Least costs", plain_markdown(optima(found)), *notes(found)]
    contents["optimise.md"] = "\n\n".join(texts) + "\n"
    paths = write_all(experiment.directory, contents)
    drawings = {
        "quality_runtime": quality_figure, "anytime": anytime_figure, "targets": targets_figure, "learning_rates": rates_figure,
        "path_quality": path_figure,
    }  # fmt: skip
    with styled():
        for stem, draw in drawings.items():
            figure = draw(found, default)
            if figure is not None:
                paths += save(figure, experiment.directory / stem, experiment.formats)
    return paths


# ------------------------------------------------------------------------------------------------------- tables


def methods(summed: pd.DataFrame) -> pd.DataFrame:
    """Return the summary as a table of texts, the best score first."""
    lines = []
    for row in summed.sort_values("score", ascending=False).to_dict("records"):
        lines.append({
            "method": row["method"], "score": interval(row, "score", 3), "beats fobg": interval(row, "improvement"),
            "profile": number(row["profile"]), "tunings": str(row["tunings"]), "median over tunings": number(row["median_score"]),
            "diverged": f"{row['diverged']} of {row['searches']}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def interval(row: Any, name: str, digits: int = 2) -> str:
    """Write a number with its interval."""
    if not isinstance(row[name], float) or math.isnan(row[name]):
        return "-"
    return "{} [{}, {}]".format(*(number(row[key], digits) for key in (name, f"{name}_low", f"{name}_high")))


def arrivals(reached: pd.DataFrame) -> pd.DataFrame:
    """Return the times to targets as a table of texts."""
    lines = []
    for row in reached.to_dict("records"):
        rate = f"{row['successes']}/{row['searches']} [{number(row['rate_low'])}, {number(row['rate_high'])}]"
        lines.append({
            "problem": row["problem"], "method": row["method"], "tuning": row["tuning"], "regret": f"1/{row['target']:g}",
            "arrived": rate, "aRT": interval(row, "art"),
        })  # fmt: skip
    return pd.DataFrame(lines)


def optima(found: RunSet) -> pd.DataFrame:
    """Return J* of each problem, and how it is known."""
    first = found.rows.drop_duplicates("problem")
    return pd.DataFrame({
        "problem": first["problem"], "class": first["scene_class"], "J0": first["start_cost"].map(lambda x: f"{x:.6g}"),
        "J*": first["least"].map(lambda x: f"{x:.8g}"), "known as": first["least_status"],
    })  # fmt: skip


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the findings, the methods, and the reasons of searches without a result."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 160)
    counts = ", ".join(f"{n} {status}" for status, n in rows["status"].value_counts().items())
    console.print(f"\n{experiment.name}: {experiment.question}\n{counted(len(rows), 'cell')}: {counts}")
    found, default = aggregate.races(experiment, rows), default_ratio(experiment)
    if len(found.rows):
        for lines in (
            methods(aggregate.summary(found, default)),
            arrivals(aggregate.targets(found, default)),
            optima(found),
        ):
            grid = Table(box=None, padding=(0, 2, 0, 0))
            for name in lines:
                grid.add_column(str(name))
            for line in lines.to_numpy():
                grid.add_row(*map(str, line))
            console.print(grid, "")
        for sentence in findings.sentences(found, default):
            console.print(sentence)
    for reason in rows.loc[rows["reason"] != "", "reason"].unique():
        console.print(reason)
    console.print(*notes(found))


# ------------------------------------------------------------------------------------------------------- charts


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return each method's colour and marker, its estimator's own, and line style.

    Those that look at costs only, the context, are grey and dashed.
    """
    styles: dict[str, dict[str, Any]] = {}
    own: dict[str, Any]
    seen: Counter[str] = Counter()
    for method in methods:
        name = re.split(r"[\[,]", method)[0] if ", " in method else ""
        turn = seen[name]
        seen[name] += 1
        if name:
            own = {"color": ink(name), "marker": stamp(name, turn), "linestyle": VARIANTS[turn % len(VARIANTS)]}
        else:
            grey, dashes = CONTEXT[turn % len(CONTEXT)]
            own = {"color": grey, "marker": MARKERS[turn % len(MARKERS)], "linestyle": dashes}
        styles[method] = own
    return styles


def _grid(count: int, most: int, height: float, title: str) -> tuple[Figure, list[Axes]]:
    across = columns(count, most)
    down = math.ceil(count / across)
    drawn = Figure(figsize=(WIDTH, height * down + 1.0), layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.suptitle(textwrap.fill(title, LETTERS), fontsize=9, fontweight="bold")
    panels = list(drawn.subplots(down, across, squeeze=False).ravel())
    for spare in panels[count:]:
        spare.remove()
    return drawn, panels[:count]


def _legend(drawn: Figure, names: dict[str, dict[str, Any]], extra: tuple[Any, ...] = ()) -> None:
    handles = [*(Line2D([], [], label=plain(name), **style) for name, style in names.items()), *extra]
    longest = max(0.6 + inches(str(handle.get_label())) for handle in handles)
    across = max(1, min(3, int(drawn.get_figwidth() / longest)))
    drawn.legend(handles=handles, loc="outside lower center", ncols=across, columnspacing=1.2)


def quality_figure(found: RunSet, default: float) -> Figure | None:
    """Draw runtime to a tenth of the first regret against the gradient's error at the start, a panel per class of scene."""
    points = aggregate.quality(found, default)
    if points.empty:
        return None
    rho = aggregate.correlations(points).set_index("scene_class")
    styles = {name: style for name, style in looks(found.methods).items() if name in set(points["method"])}
    marked = points["problem"] if points["problem"].nunique() <= len(MARKERS) else points["problem"].map(_scene)
    marks = {mark: MARKERS[i % len(MARKERS)] for i, mark in enumerate(dict.fromkeys(marked))}
    points = points.assign(mark=marked)
    groups = list(points.groupby("scene_class", sort=False))
    drawn, panels = _grid(len(groups), 3, 2.3, findings.sooner(rho.reset_index()))
    for panel, (name, part) in zip(panels, groups, strict=True):
        reached = part[np.isfinite(part["art"])]
        missed = part[~np.isfinite(part["art"])]
        # a search that never arrives is drawn at the upper edge, hollow
        top = 3.0 * max([*reached["art"], *missed["most"], 1.0])
        for row in part.to_dict("records"):
            style = {**styles[row["method"]], "marker": marks[row["mark"]], "linestyle": "none"}
            arrived = math.isfinite(row["art"])
            panel.plot(
                [max(row["rmse_rel"], 1e-6)], [max(row["art"], 1.0) if arrived else top], label=plain(row["method"]),
                markerfacecolor=style["color"] if arrived else "#ffffff", **style,
            )  # fmt: skip
        low = max(min(reached["art"].min() if len(reached) else top, top) / 3, 0.3)
        log_axis(panel, "x", max(part["rmse_rel"].min(), 1e-6) / 2, max(part["rmse_rel"].max(), 1e-6) * 2)
        log_axis(panel, "y", low, top * 1.6)
        line = rho.loc[name]
        text = (
            f"rho {line['rho']:.2f} [{line['rho_low']:.2f}, {line['rho_high']:.2f}]"
            if line["rho"] == line["rho"]
            else "rho -"
        )
        text += f",\nchance {line['chance']:.2f} in random order" if line["rho"] == line["rho"] else ""
        panel.set_title(f"{name}: {text}")
        panel.set_xlabel("relative error of a gradient, at the start")
        panel.set_ylabel("aRT to regret/10 [rollouts]")
    shapes = tuple(
        Line2D([], [], label=plain(name), color="#808080", marker=mark, linestyle="none")
        for name, mark in marks.items()
    )
    hollow = Line2D(
        [], [], label="never arrived", color="#808080", marker="o", markerfacecolor="#ffffff", linestyle="none"
    )
    _legend(
        drawn, {name: {**style, "marker": "", "linestyle": "-"} for name, style in styles.items()}, (*shapes, hollow)
    )
    return drawn


def path_figure(found: RunSet, default: float) -> Figure | None:
    """Draw the gradient's relative error and cosine along the path, a row of panels each: median and 20% to 80% of seeds.

    None where quality was measured at the start alone.
    """
    lines = aggregate.path_quality(found)
    if lines.empty:
        return None
    names = list(dict.fromkeys(lines["problem"]))
    drawn = Figure(figsize=(min(WIDTH, max(0.5 * WIDTH, 1.9 * len(names))), 4.9), layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.suptitle("How good is the gradient on the way?", fontsize=9, fontweight="bold")
    grid = drawn.subplots(2, len(names), squeeze=False)
    styles = {name: style for name, style in looks(found.methods).items() if name in set(lines["method"])}
    labels = {"rmse_rel": "relative RMSE of the gradient", "cosine": "cosine with the reference"}
    for row, (quantity, label) in zip(grid, labels.items(), strict=True):
        for panel, problem in zip(row, names, strict=True):
            part = lines[(lines["problem"] == problem) & (lines["quantity"] == quantity)]
            for method, own in part.groupby("method", sort=False):
                style = styles[str(method)]
                panel.fill_between(
                    own["iteration"], own["low"], own["high"], color=style["color"], alpha=0.15, linewidth=0
                )
                panel.plot(own["iteration"], own["value"], label=plain(str(method)), **style)
            panel.set_xlabel("iteration")
            if quantity == "rmse_rel":
                known = part[(part["low"] > 0) & np.isfinite(part["high"])]
                if len(known):
                    log_axis(panel, "y", known["low"].min() / 2, known["high"].max() * 2)
                panel.set_title(_wrapped(str(problem)), fontsize=7)
            else:
                panel.set_ylim(-1.05, 1.05)
        row[0].set_ylabel(label)
    _legend(drawn, styles)
    return drawn


def anytime_figure(found: RunSet, default: float) -> Figure:
    """Draw regret against rollouts, and against seconds where they were measured: median and 20% to 80% of seeds."""
    units = ("rollouts", "seconds") if found.rows["search_s"].notna().any() else ("rollouts",)
    names, styles = found.problems, looks(found.methods)
    across = columns(len(names), ACROSS)
    down = math.ceil(len(names) / across) * len(units)
    drawn = Figure(figsize=(WIDTH, 1.9 * down + 1.0), layout="constrained")
    FigureCanvasAgg(drawn)
    title = findings.closest(aggregate.summary(found, default))
    drawn.suptitle(
        f"{textwrap.fill(title, LETTERS)}\nRegret on the way, each method at its best tuning",
        fontsize=9,
        fontweight="bold",
    )
    grid = drawn.subplots(down, across, squeeze=False)
    blocks = grid.reshape(-1, len(units), across).swapaxes(1, 2).reshape(-1, len(units))
    for spare in blocks[len(names) :].ravel():
        spare.remove()
    for problem, panels in zip(names, blocks, strict=False):
        rows = found.rows[found.rows["problem"] == problem]
        part, ratio = found.best[found.best["problem"] == problem], aggregate.ratio_of(rows, default)
        for unit, panel in zip(units, panels, strict=True):
            for method, own in part.groupby("method", sort=False):
                places = [
                    aggregate.spent(row, ratio) if unit == "rollouts" else np.asarray(row["path_s"], dtype=float)
                    for _, row in own.iterrows()
                ]
                _draw_curve(panel, own, places, styles[str(method)])
            panel.set_yscale("log")
            low, high = panel.get_ylim()
            panel.set_ylim(max(low, DEPTH * high), high)
            panel.set_xscale("log")
            panel.set_xlabel(unit)
        first = rows.iloc[0]
        panels[0].set_title(
            f"{_wrapped(problem)}\nJ* = {first['least']:.6g},\n{textwrap.fill(short(first['least_status']), 22)}",
            fontsize=7,
        )
    for line in grid:
        line[0].set_ylabel("J - J*")
    _legend(drawn, styles)
    return drawn


def _scene(problem: str) -> str:
    """Return the scene's bare name, for charts of more problems than there are markers."""
    return problem.partition(",")[0].partition("[")[0]


def _wrapped(name: str) -> str:
    """Break a name at its commas, into lines that fit a panel."""
    return wrapped(plain(name).split(", "), TITLE)


def short(status: str) -> str:
    """Return how J* is known in a few words."""
    return status.partition(",")[0] if len(status) > 34 else status


def _draw_curve(panel: Axes, rows: pd.DataFrame, places: list[np.ndarray], style: dict[str, Any]) -> None:
    ends = [place[-1] for place in places if len(place) > 1]
    starts = [place[1] for place in places if len(place) > 1]
    if not ends or max(ends) <= 0:
        return
    grid = np.geomspace(max(min(starts), 1e-6), max(ends), STEPS)
    low, middle, high = np.where(np.isfinite(found := aggregate.curve(rows, places, grid)), found, np.nan)
    panel.fill_between(grid, low, high, color=style["color"], alpha=0.15, linewidth=0)
    panel.plot(grid, middle, **style, markevery=STEPS // 5, markersize=3)


def targets_figure(found: RunSet, default: float) -> Figure:
    """Draw the share of problems, targets and restarts that are reached, against rollouts."""
    styles, times = looks(found.methods), aggregate.runtimes(found, default)
    drawn, (panel,) = _grid(
        1, 1, 2.6, findings.reaches({name: float(np.isfinite(t).mean()) for name, t in times.items()})
    )
    longest = max([1.0, *(float(t[np.isfinite(t)].max()) for t in times.values() if np.isfinite(t).any())])
    shortest = min(
        [
            longest,
            *(float(t[np.isfinite(t) & (t > 0)].min()) for t in times.values() if (np.isfinite(t) & (t > 0)).any()),
        ]
    )
    grid = np.geomspace(max(shortest, 1.0) / 1.5, longest * 1.5, STEPS)
    for method, values in times.items():
        share = [(values <= x).mean() for x in grid]
        panel.plot(grid, share, **styles[method], markevery=STEPS // 5, markersize=3, label=plain(method))
    panel.set_xscale("log")
    panel.set_ylim(-0.02, 1.02)
    panel.set_xlabel("rollouts with simulated restarts, a gradient at its time")
    panel.set_ylabel("share of targets (regret/10, /100, /1000)")
    _legend(drawn, {name: styles[name] for name in times})
    return drawn


def rates_figure(found: RunSet, default: float) -> Figure | None:
    """Draw the score against each tuned parameter, a panel per problem; None where nothing is tuned."""
    lines = aggregate.rates(found)
    lines = (
        lines[lines.groupby(["problem", "method", "axis"])["value"].transform("nunique") > 1] if len(lines) else lines
    )
    if not len(lines):
        return None
    groups = list(lines.groupby(["axis", "problem"], sort=False))
    drawn, panels = _grid(len(groups), 3, 2.0, findings.moved(lines))
    styles = {name: style for name, style in looks(found.methods).items() if name in set(lines["method"])}
    for panel, ((axis, problem), part) in zip(panels, groups, strict=True):
        for method, own in part.groupby("method", sort=False):
            own = own.sort_values("value")
            panel.fill_between(
                own["value"], own["low"], own["high"], color=styles[str(method)]["color"], alpha=0.15, linewidth=0
            )
            panel.plot(own["value"], own["score"], **styles[str(method)], label=plain(str(method)))
        if (part["value"] > 0).all():
            log_axis(panel, "x", part["value"].min() / 1.3, part["value"].max() * 1.3, sorted(set(part["value"])))
        panel.set_ylim(-0.03, 1.03)
        panel.set_title(_wrapped(str(problem)), fontsize=7)
        panel.set_xlabel(plain(str(axis)))
        panel.set_ylabel("score")
    _legend(drawn, styles)
    return drawn
