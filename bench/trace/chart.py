"""Writes the files of a trace: the table of one rollout, and a chart with a shared time axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark, Style
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.report.names import short_names
from bench.report.text import number
from bench.run.files import make_directory, write_whole
from bench.trace.spikes import MEASURES, align, spikes
from bench.trace.trace import Trace

SPIKE, TERMINAL = "spike: the largest changes over a step", "terminal cost"
STYLES = {"": Style("#0072B2", ""), SPIKE: Style("#D55E00", "", width=2.6), TERMINAL: Style("#000000", "o", "none")}
QUANTITIES = {
    "gap": "gap [m]",
    "contacts": "contacts",
    "force": "force [N]",
    "jacobian_norm": "|dx_k+1 / dx_k|",
    "adjoint_norm": "|dL / dx_k|",
    "cost_stage": "cost",
    "cost_terminal": "cost",
}
"""The panels by the columns that they show."""


def write(trace: Trace, results_dir: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write ``trace.csv``, which has the plotted data, and the chart in the given formats; return their paths.

    The directory is ``results_dir/trace/<scene>``. Raises :class:`StorageError` if a file cannot be written.
    """
    directory = results_dir / "trace" / trace.scene
    make_directory(directory)
    paths = [directory / "trace.csv"]
    write_whole(paths[0], trace.table.to_csv(index=False).encode())
    with styled():
        return [*paths, *save(draw(chart(trace)), directory / "trace", formats)]


def chart(trace: Trace) -> Chart:
    """Return the chart of gap, contacts and force (or of positions), step Jacobian, adjoint and cost against time.

    States in contact are shaded, contact switches are thin vertical lines, and spikes are thick.
    """
    table, notes = trace.table, {}
    positions = [name for name in table if str(name)[0] in "qv" and str(name)[1:].isdigit()]
    shown = {name: "positions" for name in positions if name[0] == "q"} or dict.fromkeys(positions, "state")
    shown = {} if table["gap"].notna().any() else shown
    least = {"contacts": 1}  # whether a single contact acts is shaded
    shown |= {name: title for name, title in QUANTITIES.items() if (table[name].abs() > least.get(name, 0)).any()}
    parts = []
    for name, title in shown.items():
        series = TERMINAL if name == "cost_terminal" else name if name in positions else ""
        parts.append(
            pd.DataFrame({"panel": title, "series": series, "line": name, "time": table["time"], "value": table[name]})
        )
        if name in MEASURES:
            for k in np.flatnonzero(spikes(table[name])):
                parts.append(parts[0].iloc[k : k + 2].assign(series=SPIKE, panel=title, line=k, value=table[name]))
            found = align(table[name], table["switch"])
            if found.spikes and table["switch"].any():
                notes[title] = (
                    f"{found.near} of {found.spikes} spikes at a switch, {found.chance:.0%} by chance, p = {found.p_value:.1g}"
                )
        elif title == "cost":
            notes[title] = f"sum {number(table[['cost_stage', 'cost_terminal']].sum().sum(), 3)}"
    frame = pd.concat(parts, ignore_index=True)
    frame["value"] = frame["value"].where(frame["value"].abs() < 1e30)  # a diverging quantity; the table has it
    time = table["time"].to_numpy()
    half = 0.5 * (time[1] - time[0])
    marks = [Mark("in contact", time[i] - half, time[j - 1] + half) for i, j in _runs(table["contacts"])]
    marks += [Mark("", time[k] - half) for k in np.flatnonzero(table["switch"])]
    return Chart(
        "trace",
        frame,
        [Column("time", unit="s")],
        [Column("value", label=" ")],
        title="Where along the rollout does the gradient grow?",
        subtitle=short_names([trace.title], is_whole=True)[trace.title],
        series="series",
        line="line",
        panel="panel",
        panel_notes=notes,
        styles=STYLES,
        marks=marks,
        own_scales=True,
        across=1,
        height=0.95,
    )


def _runs(values: pd.Series) -> Iterator[tuple[int, int]]:
    """Return first and last place, exclusive, of each run of positive values."""
    edges = np.diff(np.concatenate([[0], values > 0, [0]]))
    return zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)
