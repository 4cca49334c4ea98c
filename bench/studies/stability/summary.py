"""Draws one figure that summarises all stability maps: the verdicts' shares for each integrator and contact law."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.study_tables import titled_figure
from bench.report.style import plain
from bench.run.files import write_whole
from bench.studies.stability.report import (
    DARK,
    FILLS,
    LOST,
    VERDICTS,
    Panel,
    arrange_maps,
    colour_legend,
    looks,
    panels,
    with_verdict,
)

SHORT = {"by step": "step", "by law": "law", "by both": "both", "by unknown": "?"} | {
    name: VERDICTS[name][0] for name in LOST
}
"""Labels of a bar's segments, drawn where a segment is wide enough."""
CHARACTER = 0.055
"""Width of a character, as a share of a bar's length."""


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write the summary as ``stability_summary``, unless no cell has a verdict; return the files' paths."""
    maps = panels(arrange_maps(experiment, rows))
    if not any(len(with_verdict(panel.rows)) for panel in maps):
        return []
    with styled():
        paths = save(figure(maps), experiment.directory / "stability_summary", experiment.formats)
    # plotted data cannot be read back from bars: write the counts that the bars show
    write_whole(paths[-1], count_cells(maps).to_csv(index=False, lineterminator="\n").encode())
    return paths


def count_cells(maps: Sequence[Panel]) -> pd.DataFrame:
    """Return the number of cells by problem (scene and law, without parameters), integrator and key of the colour."""
    parts = [
        with_verdict(panel.rows).assign(integrator=panel.kind[0], problem=_problem(*panel.kind[1:])) for panel in maps
    ]
    cells = pd.concat(parts).assign(look=looks)
    return cells.groupby(["problem", "integrator", "look"], sort=False).size().rename("cells").reset_index()


def _problem(scene: str, contact: str) -> str:
    return scene if contact == "none" else f"{scene}, {contact}"


def headline(table: pd.DataFrame) -> str:
    """Format the share of right gradients over all cells, and the integrator and problem with the largest share."""
    totals = table.groupby(["problem", "integrator"], sort=False)["cells"].sum()
    right = table[table["look"] == "ok"].groupby(["problem", "integrator"])["cells"].sum()
    shares = (right.reindex(totals.index).fillna(0) / totals).sort_values(ascending=False)
    (problem, integrator), best = shares.index[0], float(shares.iloc[0])
    never = int((shares == 0).sum())
    whole = table.groupby("look")["cells"].sum() / totals.sum()
    wrong = [f"by the {name} in {whole[f'by {name}']:.0%}" for name in ("step", "law") if f"by {name}" in whole]
    text = f"The gradient is right in {whole.get('ok', 0.0):.0%} of the cells" + (
        f", wrong {', '.join(wrong)}" if wrong else ""
    )
    text += f"; right most often ({best:.0%}) with {integrator} on {problem}"
    return text + (f", never in {never} of {len(shares)} combinations" if never else "")


def figure(maps: Sequence[Panel]) -> Figure:
    """Draw a panel per problem with a bar per integrator: shares of its cells by verdict and cause, right ones first."""
    table = count_cells(maps)
    names = [name for name in FILLS if name in set(table["look"])]
    problems, integrators = (list(dict.fromkeys(table[column])) for column in ("problem", "integrator"))
    drawn = titled_figure(WIDTH, 1.35 + 0.21 * len(integrators), plain(headline(table)))
    grid = drawn.subplots(1, len(problems), squeeze=False, sharey=True)[0]
    for panel, problem in zip(grid, problems, strict=True):
        cells = table[table["problem"] == problem].pivot(index="integrator", columns="look", values="cells").fillna(0)
        for integrator, shares in cells.div(cells.sum(axis=1), axis=0).iterrows():
            height, left = len(integrators) - 1 - integrators.index(str(integrator)), 0.0
            for name in names:
                share = float(shares.get(name, 0.0))
                panel.barh(height, share, left=left, color=FILLS[name], edgecolor="white", linewidth=0.4)
                label = SHORT.get(name, name)
                if share >= CHARACTER * (len(label) + 1):
                    colour = "white" if name in DARK else "black"
                    panel.text(left + share / 2, height, label, ha="center", va="center", fontsize=6.5, color=colour)
                left += share
        panel.set(xlim=(0, 1), ylim=(-0.6, len(integrators) - 0.4))
        panel.set_xticks([0, 0.5, 1], ["0", "50%", "100%"])
        panel.set_yticks(range(len(integrators)), [plain(name) for name in reversed(integrators)])
        panel.tick_params(axis="y", length=0)
        panel.set_title("\n".join(plain(problem).split(", ")), pad=4)
    rows = pd.concat([panel.rows for panel in maps])
    drawn.legend(handles=colour_legend(rows), loc="outside lower center", ncols=2, columnspacing=1.2)
    return drawn
