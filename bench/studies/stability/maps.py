"""The maps of verdicts over step size and stiffness: one per integrator and problem, with both stability limits.

It needs no plugin, because the theoretical boundary is stored in the column ``stiffness_limit``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.report.problems import (
    axes_of,
    distinguishing_columns,
    part_columns,
    problem_names,
    problem_numbers,
    value_text,
)
from bench.report.text import axis_value
from bench.report.views import Arranged, arrange, attempted

VERDICTS = {
    "ok": "within {inaccurate} of the truth",
    "inaccurate": "off by more than {inaccurate}",
    "wrong_sign": "wrong sign",
    "zero": "exactly 0 where the truth is not",
    "diverged": "state diverged",
    "nonfinite": "state or gradient not finite",
    "unresolved": "truth not resolved",
}
"""The meaning of each verdict, with placeholders for the study's limits."""
WRONG = ("inaccurate", "wrong_sign", "zero")
"""Verdicts of finite but wrong gradients, which have a cause."""
LOST = ("diverged", "nonfinite")
"""Verdicts of cells whose state or gradient is lost: they count as unstable."""
GROWING = 1 + 1e-9
"""Measured growth per step above which a state counts as growing: 1 plus rounding."""
PLACES = ("dt", "stiffness")
"""The axes of a map."""
STEP = ("scene", "contact", "integrator")


@dataclass(frozen=True, eq=False)
class Panel:
    """The map of one integrator and problem, on the backends that agree in every verdict."""

    integrator: str
    """Identity string of the integrator; the next two are the identity strings of the scene and the contact law."""
    scene: str
    contact: str
    values: Mapping[str, str]
    """Values, as strings, of the columns that distinguish the map from other maps: :func:`label_columns_of`."""
    kind: tuple[str, ...]
    """Names of integrator, scene and law, without parameters."""
    backends: tuple[str, ...]
    rows: pd.DataFrame

    @property
    def problem(self) -> str:
        """The scene and the law: ``bouncing_ball, penalty``."""
        return self.scene if self.contact == "none" else f"{self.scene}, {self.contact}"

    @property
    def variant(self) -> str:
        """The values that distinguish the map from others of the same integrator and problem: ``damping=0``."""
        return ", ".join(f"{name}={value}" for name, value in self.values.items() if value != "-")

    @property
    def title(self) -> str:
        """The problem and the variant: ``bouncing_ball, penalty, damping=0``."""
        return ", ".join(filter(None, (self.problem, self.variant)))

    @cached_property
    def boundary(self) -> pd.DataFrame:
        """The stability limit by dt: ``limit`` in theory, ``low`` and ``high`` as measured, and ``agrees``.

        ``high`` is the lowest unstable stiffness of the grid (infinite without one), and ``low`` the next lower
        stiffness (0 without one). A cell is unstable if it diverged or its state was measured to grow. ``agrees`` is 1
        where the limit lies in the interval widened by one cell of the grid, else 0.
        """
        limits = {}
        for dt, part in self.rows.dropna(subset=["stiffness", "stiffness_limit"]).groupby("dt"):
            part = part.sort_values("stiffness")
            k, lost = part["stiffness"].to_numpy(), unstable(part).to_numpy()
            first = int(np.argmax(lost)) if lost.any() else len(k)
            padded = np.concatenate([[0.0, 0.0], k, [math.inf, math.inf]])
            limit = float(part["stiffness_limit"].median())
            agrees = padded[first] <= limit <= padded[first + 3]
            limits[dt] = {"limit": limit, "low": padded[first + 1], "high": padded[first + 2], "agrees": agrees}
        columns = ["limit", "low", "high", "agrees"]
        return pd.DataFrame([list(row.values()) for row in limits.values()], list(limits), columns).astype(float)


def unstable(rows: pd.DataFrame) -> pd.Series:
    """Return a mask of the unstable cells: diverged, not finite, or with a state that was measured to grow."""
    return rows["verdict"].isin(LOST) | (rows["growth_factor"] > GROWING)


def with_verdict(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of cells that have a verdict."""
    rows = attempted(rows)
    return rows[rows["verdict"] != ""]


def arrange_maps(experiment: Experiment, rows: pd.DataFrame) -> Arranged:
    """Arrange rows for reading, with each cell's stored step size and stiffness; the cause is empty in older rows."""
    shown = arrange(experiment, rows)
    cause = rows["cause"].fillna("") if "cause" in rows else ""
    return replace(shown, rows=shown.rows.assign(**{name: rows[name] for name in PLACES}, cause=cause))


def panels(shown: Arranged) -> list[Panel]:
    """Return the maps, grouped by integrator, scene and law.

    A map has all rows with equal parameters of scene, contact law and integrator, except step size and stiffness.
    Backends with equal maps share one map, and backends that support no cell of a map are omitted.
    """
    over = axes_of(shown, *PLACES)
    rows = shown.rows.assign(
        map=problem_numbers(shown.rows, STEP, over),
        kind=[
            tuple(name_of(given.get(part)) for part in ("integrator", "scene", "contact"))
            for given in parse(shown.rows)
        ],
        machine=problem_names(shown, ["backend"], always=["backend"]),
    )
    labels = label_columns_of(shown, over)
    maps: list[Panel] = []
    for _, part in rows.groupby("map", sort=False):
        groups: list[tuple[pd.DataFrame, list[str]]] = []
        for backend, cells in part.groupby("machine", sort=False):
            cells = cells.drop_duplicates(list(PLACES), keep="last").sort_values(list(PLACES))
            if attempted(cells).empty:
                continue
            equal = next((group for group in groups if _have_equal_verdicts(group[0], cells)), None)
            if equal is None:
                groups.append((cells, [str(backend)]))
            else:
                equal[1].append(str(backend))
        first = part.iloc[0]
        integrator, scene, contact = (str(first[name]) for name in ("integrator", "scene", "contact"))
        values = {name: value_text(first[name]) for name in labels}
        maps += [
            Panel(integrator, scene, contact, values, first["kind"], tuple(names), table) for table, names in groups
        ]
    kinds = list(dict.fromkeys(panel.kind for panel in maps))
    return sorted(maps, key=lambda panel: kinds.index(panel.kind))


def label_columns_of(shown: Arranged, over: Sequence[Axis]) -> list[str]:
    """Return the columns, besides integrator, scene and law, that distinguish the maps."""
    basic = ("integrator", "scene", "contact")
    names = [*basic, *(name for name in part_columns(shown, STEP, over) if name not in (*basic, *PLACES, "horizon"))]
    return [
        name
        for name in distinguishing_columns(shown.rows, problem_numbers(shown.rows, STEP, over), names, basic)
        if name not in basic
    ]


def name_of(part: Any) -> str:
    """Return the name of a plugin given by its parameters in a row; ``none`` for no plugin."""
    return "none" if part is None else str(part["name"])


def limits(rows: pd.DataFrame) -> dict[str, str]:
    """Return the studies' limits as strings: ``{"inaccurate": "10%"}``, or ``10% or 20%`` if the rows' studies differ."""
    texts = dict.fromkeys(given["study"]["inaccurate"] for given in parse(rows) if given)
    return {"inaccurate": " or ".join(f"{100 * limit:g}%" for limit in texts)}


def meaning(verdict: str, rows: pd.DataFrame) -> str:
    """Return the meaning of a verdict, with the limits of the rows' studies."""
    return VERDICTS[verdict].format(**limits(rows))


def _have_equal_verdicts(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    """Return whether two maps have the same cells and verdicts."""
    names = ["dt", "stiffness", "verdict", "cause", "status"]
    return bool(a[names].reset_index(drop=True).equals(b[names].reset_index(drop=True)))


def limits_of(panel: Panel) -> list[str]:
    """Format a dt, the theoretical and measured stability limits at that dt, and the number of dt at which they agree."""
    limits = panel.boundary
    if limits.empty:
        return ["-"] * 4
    inside = (limits["low"] > 0) & np.isfinite(limits["high"])
    chosen = limits[inside] if inside.any() else limits
    dt = chosen.index[len(chosen) // 2]
    row = chosen.loc[dt]
    theory = {0.0: "never stable", math.inf: "always stable"}.get(
        row["limit"], axis_value(float(f"{row['limit']:.3g}"))
    )
    return [
        axis_value(dt),
        theory,
        _between(row["low"], row["high"]),
        f"{int(limits['agrees'].sum())} of {len(limits)}",
    ]


def _between(low: float, high: float) -> str:
    if low == 0:
        return f"below {axis_value(high)}"
    return f"above {axis_value(low)}" if math.isinf(high) else f"{axis_value(low)} to {axis_value(high)}"
