"""Gradient checks as files: a long table, a summary with the line that repeats each fault, and a chart."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from bench.gradcheck import FAULTS, VERDICTS
from bench.grid import Experiment
from bench.report.figures import save, styled
from bench.report.style import GREY, PALETTE, STYLE, plain
from bench.report.tables import escape_markdown
from bench.report.views import number
from bench.store import IDENTITY, write_whole

POINTS: dict[str, Any] = {"start": "-", "before": (0, (4, 1.5)), "at": (0, (1, 1.2)), "after": (0, (6, 1.5, 1, 1.5))}
"""Line styles of the points at which gradients are checked."""
FLOOR, CEILING = 1e-16, 1e2
"""Errors beyond these are drawn at the edge."""
ACROSS = 4
CHECK = ["point", "sample", "direction", "derivative_program"]
EACH = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
ORDER = [*CHECK, "eps", *EACH, "verdict"]
PROBLEM = ["scene", "contact", "integrator"]


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``gradient_check`` (.csv, .md, .png, .svg) and print the verdicts; returns the files' paths."""
    table = long_table(rows)
    summary = by_point(rows)
    directory = experiment.directory
    write_whole(directory / "gradient_check.csv", table.to_csv(index=False, lineterminator="\n").encode())
    write_whole(directory / "gradient_check.md", markdown(experiment, rows, summary).encode())
    paths = [directory / "gradient_check.csv", directory / "gradient_check.md"]
    checked = table[table["eps"].notna() & np.isfinite(table["relative_error"])]
    if not checked.empty:
        paths += _draw(directory, checked)
    _show(experiment, rows, summary)
    return paths


def failed(rows: pd.DataFrame) -> bool:
    """Whether some check found a fault."""
    return bool(rows["verdict"].isin(FAULTS).any())


# ------------------------------------------------------------------------------------------------------ tables


def checks(rows: pd.DataFrame) -> Iterator[tuple[dict[str, Any], int, str]]:
    """Each check of each row: the row, the number of the check in it, and its verdict."""
    for row in rows.to_dict("records"):
        for i, verdict in enumerate(row["check_verdict"]):
            yield {str(name): value for name, value in row.items()}, i, verdict


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """One line per cell, check and eps; one line for a cell that could not be checked."""
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    lines = []
    for row, i, verdict in checks(rows):
        told = {name: row[name] for name in whole} | {name: row[name][i] for name in CHECK}
        count = len(row["eps"])
        for k in range(count):
            values = {name: row[name][i * count + k] for name in EACH}
            lines.append(told | {"eps": row["eps"][k]} | values | {"verdict": verdict, "key": row["key"]})
    unchecked = rows[[len(found) == 0 for found in rows["check_verdict"]]]
    lines += unchecked[[*whole, "verdict", "key"]].to_dict("records")  # type: ignore[arg-type]
    table = pd.DataFrame(lines, columns=[*whole, *ORDER, "key"])
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, "Int64"))


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """The checks of each cell and point as one line: the worst verdict, and the largest best error with its eps."""
    lines = []
    for row, i, verdict in checks(rows):
        told = {name: row[name] for name in (*PROBLEM, "backend", "horizon", "dtype", "key", "command")}
        result = {"verdict": verdict, "error": row["check_error"][i], "eps": row["check_eps"][i]}
        lines.append(told | {"point": row["point"][i], "rank": VERDICTS.index(verdict)} | result)
    names = [*PROBLEM, "horizon", "point", "backend", "dtype", "verdict", "error", "eps", "command", "key", "rank"]
    table = pd.DataFrame(lines, columns=names)
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    first = table.drop_duplicates(["key", "point"])
    return first.sort_index()


def markdown(experiment: Experiment, rows: pd.DataFrame, summary: pd.DataFrame) -> str:
    """The verdict of each cell and point, backends that agree on one line; then what repeats each fault."""
    title = experiment.question or experiment.name
    out = [f"# {escape_markdown(title)}", ""]
    headers = ["scene", "contact", "horizon", "point", "backends", "verdict", "best error", "best eps"]
    out += ["| " + " | ".join(headers) + " |", "|---|---|--:|---|---|---|--:|--:|"]
    groups = summary.groupby([*PROBLEM, "horizon", "point", "verdict"], sort=False)
    for _, group in groups:
        worst = group.loc[group["error"].idxmax()] if group["error"].notna().any() else group.iloc[0]
        backends = ", ".join(dict.fromkeys(group["backend"]))
        cells = [worst["scene"], worst["contact"], f"{worst['horizon']:g}", worst["point"], backends, worst["verdict"]]
        cells += [number(worst["error"]), f"{worst['eps']:.0e}"]
        out.append("| " + " | ".join(escape_markdown(cell) for cell in cells) + " |")
    out += [
        "",
        "- best error: the smallest |a - b| / max(1, |a|, |b|) of derivative and central differences over all eps; of the "
        "directions, samples and backends of a line the largest. eps is relative to max(1, |theta|).",
        "- verdict: the worst of a line's checks. `before` and `after` are 1e-4 from a switch of contact mode, `at` is on it.",
    ]  # fmt: skip
    lost = rows[rows["status"] != "ok"]
    if not lost.empty:
        out += ["", "Not checked:", ""]
        for reason, part in lost.groupby("reason", sort=False):
            out.append(f"- {len(part)} {part['status'].iloc[0]}: {escape_markdown(str(reason))}")
    faults = summary[summary["verdict"].isin(FAULTS)]
    if not faults.empty:
        out += ["", "Faults, and what repeats each:", ""]
        for (verdict, line), _ in faults.groupby(["verdict", "command"], sort=False):
            out += [f"- {verdict}", "", f"      {line}", ""]
    return "\n".join(out).rstrip("\n") + "\n"


def _show(experiment: Experiment, rows: pd.DataFrame, summary: pd.DataFrame) -> None:
    print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    counts = rows["status"].value_counts()
    print(f"{len(rows)} cells: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
    for (scene, contact), part in summary.groupby(["scene", "contact"], sort=False):
        told = []
        for point in POINTS:
            found = Counter(part["verdict"][part["point"] == point])
            if found:
                told.append(f"{point} " + ", ".join(f"{found[v]} {v}" for v in VERDICTS if v in found))
        print(f"  {scene}{'' if contact == 'none' else f' x {contact}'}: " + "; ".join(told))
    faults = summary[summary["verdict"].isin(FAULTS)]
    for (verdict, line), part in faults.groupby(["verdict", "command"], sort=False):
        print(f"\n{verdict} ({', '.join(dict.fromkeys(part['point']))}); repeat with\n  {line}")


# ------------------------------------------------------------------------------------------------------- chart


def _draw(directory: Path, table: pd.DataFrame) -> list[Path]:
    with styled():
        return save(figure(table), directory / "gradient_check")


def figure(table: pd.DataFrame) -> Figure:
    """Relative error against eps, a panel per problem, a curve per horizon and point: the worst of its checks."""
    problems = list(table.groupby(PROBLEM, sort=False))
    across = min(ACROSS, len(problems))
    down = math.ceil(len(problems) / across)
    size = (7.4 if across > 1 else 4.6, 0.85 + 1.55 * down)
    chart = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03))
    FigureCanvasAgg(chart)
    panels = chart.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    horizons = sorted(table["horizon"].unique())
    colours = {horizon: PALETTE[i % len(PALETTE)] for i, horizon in enumerate(horizons)}
    several = len({key[2] for key, _ in problems}) > 1
    for panel, ((scene, contact, integrator), part) in zip(panels.flat, problems, strict=False):
        _curves(panel, part, colours)
        names = [scene, *([] if contact == "none" else [contact]), *([integrator] if several else [])]
        panel.set_title("\n".join(map(plain, names)), pad=3)
    for spare in panels.flat[len(problems) :]:
        spare.remove()
    _scale(panels[0, 0], table)
    for column in range(across):
        lowest = panels[(len(problems) - 1 - column) // across, column]
        lowest.tick_params(labelbottom=True)
    for panel in panels[-1, : len(problems) - across * (down - 1)]:
        panel.set_xlabel("eps / scale of theta")
    chart.supylabel("relative error, the worst check", fontsize=STYLE["font.size"])
    known = [point for point in POINTS if point in set(table["point"])]
    handles = [Line2D([], [], color=colours[h], label=_horizon(h)) for h in horizons]
    handles += [Line2D([], [], color=GREY, linestyle=POINTS[p], label=_place(p)) for p in known]
    handles.append(Line2D([], [], color=GREY, marker="o", markersize=3.5, linestyle="none", label="best eps"))
    chart.legend(handles=handles, loc="outside lower center", ncols=4 if across > 1 else 2, columnspacing=1.2)
    chart.suptitle("Program's gradient against central differences of its cost", fontsize=9, fontweight="bold")
    return chart


def _horizon(steps: int) -> str:
    return "no steps" if steps == 0 else f"{steps} step{'' if steps == 1 else 's'}"


def _place(point: str) -> str:
    return point if point == "start" else f"{point} contact switch"


def _scale(panel: Axes, table: pd.DataFrame) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    largest = min(CEILING, max(1.0, float(table["relative_error"].max())))
    panel.set_ylim(FLOOR / 2, 4 * largest)
    panel.set_xticks([1e-10, 1e-6, 1e-2])
    panel.set_yticks([1e-15, 1e-10, 1e-5, 1.0])
    panel.minorticks_off()


def _curves(panel: Axes, part: pd.DataFrame, colours: dict[int, str]) -> None:
    for (horizon, point), checked in part.groupby(["horizon", "point"]):
        worst = checked.groupby("eps")["relative_error"].max().clip(FLOOR, CEILING)
        style: dict[str, Any] = {"color": colours[horizon], "linewidth": 1.0}
        panel.plot(worst.index, worst, linestyle=POINTS[point], **style)
        if point == "start":
            panel.plot([worst.idxmin()], [worst.min()], marker="o", markersize=3.5, clip_on=False, **style)
    panel.grid(axis="y", color="#e5e5e5", linewidth=0.5)
