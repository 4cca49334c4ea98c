"""Writes the tables and charts of searches: quality against runtime, regret along the paths, targets, learning rates."""

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
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.experiment import Experiment
from bench.report.colours import estimator_colour, estimator_marker
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.scales import log_axis
from bench.report.study_tables import (
    interval,
    open_console,
    panel_grid,
    print_reasons,
    print_table,
    titled_figure,
    write_tables,
)
from bench.report.style import DEVIANT, MARKERS, VARIANTS, plain, width_in_inches, wrapped
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.studies.optimise import aggregate, findings
from bench.studies.optimise.aggregate import RunSet

NOTES = (
    "score: share of the way from the first cost to J*, interquartile mean over searches, with a bootstrap interval "
    "stratified by problem. beats fobg: chance of a lower final cost, paired by problem and seed. profile: integral of the "
    "share of targets reached within 1 to 4 times the best method's runtime. aRT: average runtime in rollouts, where a "
    "gradient counts as many rollouts as take its time: the rollouts of all searches over the number of searches that "
    "reached the target, inf if none did. Each method is shown at its best tuning on each problem, chosen by median final "
    "cost of {seeds}, next to the number of tunings and the median score over all of them. Methods that use costs only "
    "(dashed in charts) are context and do not enter findings about gradients.",
)
ACROSS = 4
"""Most panels side by side."""
TITLE = 1.6
"""Widest line of a panel's title in inches."""
CONTEXT = tuple(zip(("#000000", "#8c8c8c", "#4d4d4d", "#b3b3b3"), (*VARIANTS[1:], *DEVIANT[:2]), strict=True))
"""Grey and line style of each method that uses only costs."""
STEPS = 80
"""Number of points of a drawn curve."""
DEPTH = 1e-7
"""Smallest regret that is drawn, as a share of the largest. Regret is 0 where J* is the lowest cost of any search."""


def notes(runs: RunSet) -> list[str]:
    """Return explanations of the tables' columns, with the seeds that chose the tunings."""
    chosen = runs.tuning_seeds
    seeds = f"seeds {', '.join(map(str, chosen))}, which do not score" if chosen else "the same seeds that score"
    return [text.format(seeds=seeds) for text in NOTES]


def default_ratio(experiment: Experiment) -> float:
    """Return the number of rollouts that a gradient counts as if no times were measured."""
    return float(getattr(experiment.study, "gradient_cost", 4.0))


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``optimise`` (.csv, .md), ``targets.csv``, ``summary.csv`` and the charts; return the files' paths."""
    runs, default = aggregate.collect_runs(experiment, rows), default_ratio(experiment)
    if not len(runs.rows):
        return write_tables(experiment, rows, "optimise", [f"# {experiment.name}", "No search gave a result."])
    reached, summary = aggregate.times_to_targets(runs, default), aggregate.summarise(runs, default)
    texts = [f"# {experiment.name}: does a better gradient reach the target sooner?"]
    texts += [*findings.sentences(runs, default), "## Methods", plain_markdown(methods(summary))]
    texts += ["## Times to targets", plain_markdown(success_table(reached))]
    texts += ["## Lowest costs", plain_markdown(optima(runs)), *notes(runs)]
    tables = {"targets.csv": reached, "summary.csv": summary}
    further = {name: table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()}
    paths = write_tables(experiment, rows, "optimise", texts, further)
    drawings = {
        "quality_runtime": quality_figure, "anytime": anytime_figure, "targets": targets_figure, "learning_rates": rates_figure,
        "path_quality": path_figure,
    }  # fmt: skip
    with styled():
        for stem, draw in drawings.items():
            figure = draw(runs, default)
            if figure is not None:
                paths += save(figure, experiment.directory / stem, experiment.formats)
    return paths


# ------------------------------------------------------------------------------------------------------- tables


def methods(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the summary formatted as strings, the best score first."""
    lines = []
    for row in summary.sort_values("score", ascending=False).to_dict("records"):
        lines.append({
            "method": row["method"], "score": interval(row, "score", digits=3), "beats fobg": interval(row, "improvement"),
            "profile": number(row["profile"]), "tunings": str(row["tunings"]), "median over tunings": number(row["median_score"]),
            "diverged": f"{row['diverged']} of {row['searches']}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def success_table(reached: pd.DataFrame) -> pd.DataFrame:
    """Return the times to targets formatted as strings."""
    lines = []
    for row in reached.to_dict("records"):
        rate = f"{row['successes']}/{row['searches']} [{number(row['rate_low'])}, {number(row['rate_high'])}]"
        lines.append({
            "problem": row["problem"], "method": row["method"], "tuning": row["tuning"], "regret": f"1/{row['target']:g}",
            "reached": rate, "aRT": interval(row, "art"),
        })  # fmt: skip
    return pd.DataFrame(lines)


def optima(runs: RunSet) -> pd.DataFrame:
    """Return each problem's class, first cost, J* and the source of J*, formatted as strings."""
    first = runs.rows.drop_duplicates("problem")
    return pd.DataFrame({
        "problem": first["problem"], "class": first["scene_class"], "J0": first["start_cost"].map(lambda x: f"{x:.6g}"),
        "J*": first["best_known"].map(lambda x: f"{x:.8g}"), "known as": first["best_known_status"],
    })  # fmt: skip


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the methods, the times to targets, the lowest costs, the findings, and the reasons of failed searches."""
    console = open_console(experiment, rows)
    runs, default = aggregate.collect_runs(experiment, rows), default_ratio(experiment)
    if len(runs.rows):
        print_table(console, methods(aggregate.summarise(runs, default)), title="\nMethods")
        print_table(console, success_table(aggregate.times_to_targets(runs, default)), title="\nTimes to targets")
        print_table(console, optima(runs), title="\nLowest costs")
        console.print(*findings.sentences(runs, default), sep="\n")
    print_reasons(console, rows)
    console.print(*notes(runs))


# ------------------------------------------------------------------------------------------------------- charts


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return each method's line style, with the colour and marker of its estimator.

    Methods that use only costs are grey and dashed.
    """
    styles: dict[str, dict[str, Any]] = {}
    uses: Counter[str] = Counter()
    for method in methods:
        name = re.split(r"[\[,]", method)[0] if ", " in method else ""
        turn = uses[name]
        uses[name] += 1
        grey, dashes = CONTEXT[turn % len(CONTEXT)]
        styles[method] = (
            {
                "color": estimator_colour(name),
                "marker": estimator_marker(name, turn),
                "linestyle": VARIANTS[turn % len(VARIANTS)],
            }
            if name
            else {"color": grey, "marker": MARKERS[turn % len(MARKERS)], "linestyle": dashes}
        )
    return styles


def _legend(drawn: Figure, names: dict[str, dict[str, Any]], extra: tuple[Any, ...] = ()) -> None:
    handles = [*(Line2D([], [], label=plain(name), **style) for name, style in names.items()), *extra]
    longest = max(0.6 + width_in_inches(str(handle.get_label())) for handle in handles)
    across = max(1, min(3, int(drawn.get_figwidth() / longest)))
    drawn.legend(handles=handles, loc="outside lower center", ncols=across, columnspacing=1.2)


def quality_figure(runs: RunSet, default: float) -> Figure | None:
    """Draw runtime to a tenth of the first regret against the gradient's error, a panel per class; None without data."""
    points = aggregate.quality_and_runtime(runs, default)
    if points.empty:
        return None
    rho = aggregate.rank_correlations(points).set_index("scene_class")
    styles = {name: style for name, style in looks(runs.methods).items() if name in set(points["method"])}
    marked = points["problem"] if points["problem"].nunique() <= len(MARKERS) else points["problem"].map(_scene)
    marks = {mark: MARKERS[i % len(MARKERS)] for i, mark in enumerate(dict.fromkeys(marked))}
    points = points.assign(mark=marked)
    groups = list(points.groupby("scene_class", sort=False))
    drawn, panels = panel_grid(len(groups), 3, 2.3, findings.effect_title(rho.reset_index()))
    for panel, (name, part) in zip(panels, groups, strict=True):
        reached = part[np.isfinite(part["art"])]
        missed = part[~np.isfinite(part["art"])]
        # a method that never reaches the target is a hollow marker at the upper edge
        top = 3.0 * max([*reached["art"], *missed["most"], 1.0])
        for row in part.to_dict("records"):
            style = {**styles[row["method"]], "marker": marks[row["mark"]], "linestyle": "none"}
            is_reached = math.isfinite(row["art"])
            panel.plot(
                [max(row["rmse_rel"], 1e-6)], [max(row["art"], 1.0) if is_reached else top], label=plain(row["method"]),
                markerfacecolor=style["color"] if is_reached else "#ffffff", **style,
            )  # fmt: skip
        low = max(min(reached["art"].min() if len(reached) else top, top) / 3, 0.3)
        log_axis(panel, "x", max(part["rmse_rel"].min(), 1e-6) / 2, max(part["rmse_rel"].max(), 1e-6) * 2)
        log_axis(panel, "y", low, top * 1.6)
        line = rho.loc[name]
        text = "rho -"
        if not math.isnan(line["rho"]):
            text = f"rho {line['rho']:.2f} [{line['rho_low']:.2f}, {line['rho_high']:.2f}],\n"
            text += f"chance {line['chance']:.2f} in random order"
        panel.set_title(f"{name}: {text}")
        panel.set_xlabel("relative error of a gradient, at the start")
        panel.set_ylabel("aRT to regret/10 [rollouts]")
    shapes = tuple(
        Line2D([], [], label=plain(name), color="#808080", marker=mark, linestyle="none")
        for name, mark in marks.items()
    )
    hollow = Line2D(
        [], [], label="never reached", color="#808080", marker="o", markerfacecolor="#ffffff", linestyle="none"
    )
    _legend(
        drawn, {name: {**style, "marker": "", "linestyle": "-"} for name, style in styles.items()}, (*shapes, hollow)
    )
    return drawn


def path_figure(runs: RunSet, default: float) -> Figure | None:
    """Draw the gradient's relative error and cosine along the path: median and 20% to 80% of seeds.

    Returns None if quality was measured only at the start.
    """
    lines = aggregate.path_quality(runs)
    if lines.empty:
        return None
    names = list(dict.fromkeys(lines["problem"]))
    width = min(WIDTH, max(0.5 * WIDTH, 1.9 * len(names)))
    drawn = titled_figure(width, 4.9, "Quality of the gradient along the path")
    grid = drawn.subplots(2, len(names), squeeze=False)
    styles = {name: style for name, style in looks(runs.methods).items() if name in set(lines["method"])}
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


def anytime_figure(runs: RunSet, default: float) -> Figure:
    """Draw regret against rollouts, and against time [s] if it was measured: median and 20% to 80% of seeds."""
    units = ("rollouts", "seconds") if runs.rows["search_s"].notna().any() else ("rollouts",)
    names, styles = runs.problems, looks(runs.methods)
    across = columns(len(names), ACROSS)
    down = math.ceil(len(names) / across) * len(units)
    title = findings.score_title(aggregate.summarise(runs, default))
    drawn = titled_figure(WIDTH, 1.9 * down + 1.0, f"{title}\nRegret along the path, each method at its best tuning")
    grid = drawn.subplots(down, across, squeeze=False)
    blocks = grid.reshape(-1, len(units), across).swapaxes(1, 2).reshape(-1, len(units))
    for spare in blocks[len(names) :].ravel():
        spare.remove()
    for problem, panels in zip(names, blocks, strict=False):
        rows = runs.rows[runs.rows["problem"] == problem]
        part, ratio = runs.best_runs[runs.best_runs["problem"] == problem], runs.gradient_ratio(problem, default)
        for unit, panel in zip(units, panels, strict=True):
            for method, own in part.groupby("method", sort=False):
                places = [
                    aggregate.rollouts_spent(row, ratio)
                    if unit == "rollouts"
                    else np.asarray(row["path_s"], dtype=float)
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
            f"{_wrapped(problem)}\nJ* = {first['best_known']:.6g},\n{textwrap.fill(short(first['best_known_status']), 22)}",
            fontsize=7,
        )
    for line in grid:
        line[0].set_ylabel("J - J*")
    _legend(drawn, styles)
    return drawn


def _scene(problem: str) -> str:
    """Return the name of a problem's scene, without parameters."""
    return problem.partition(",")[0].partition("[")[0]


def _wrapped(name: str) -> str:
    """Break a problem's name at its commas into lines that fit a panel."""
    return wrapped(plain(name).split(", "), TITLE)


def short(status: str) -> str:
    """Return the source of J*, truncated at its first comma if it is longer than 34 characters."""
    return status.partition(",")[0] if len(status) > 34 else status


def _draw_curve(panel: Axes, rows: pd.DataFrame, places: list[np.ndarray], style: dict[str, Any]) -> None:
    ends = [place[-1] for place in places if len(place) > 1]
    starts = [place[1] for place in places if len(place) > 1]
    if not ends or max(ends) <= 0:
        return
    grid = np.geomspace(max(min(starts), 1e-6), max(ends), STEPS)
    quantiles = aggregate.regret_quantiles(rows, places, grid)
    low, middle, high = np.where(np.isfinite(quantiles), quantiles, np.nan)
    panel.fill_between(grid, low, high, color=style["color"], alpha=0.15, linewidth=0)
    panel.plot(grid, middle, **style, markevery=STEPS // 5, markersize=3)


def targets_figure(runs: RunSet, default: float) -> Figure:
    """Draw the share of targets reached against rollouts, over all problems, targets and simulated restarts."""
    styles, times = looks(runs.methods), aggregate.restart_runtimes(runs, default)
    title = findings.targets_title({name: float(np.isfinite(t).mean()) for name, t in times.items()})
    drawn, (panel,) = panel_grid(1, 1, 2.6, title)
    finite = np.concatenate([t[np.isfinite(t)] for t in times.values()] or [np.empty(0)])
    longest = float(max([1.0, *finite]))
    shortest = float(min([longest, *finite[finite > 0]]))
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


def rates_figure(runs: RunSet, default: float) -> Figure | None:
    """Draw the score against each tuned parameter, a panel per problem; None if nothing was tuned."""
    lines = aggregate.scores_by_tuning(runs)
    lines = lines[lines.groupby(["problem", "method", "axis"])["value"].transform("nunique") > 1]
    if lines.empty:
        return None
    groups = list(lines.groupby(["axis", "problem"], sort=False))
    drawn, panels = panel_grid(len(groups), 3, 2.0, findings.tuning_title(lines))
    styles = {name: style for name, style in looks(runs.methods).items() if name in set(lines["method"])}
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
