"""Names of charts in words. A problem keeps the parameters that distinguish it, and a method all that are named."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import PurePath

import pandas as pd

from bench.experiment.columns import IDENTITY
from bench.experiment.views import Chart
from bench.report.problems import distinguishing_columns
from bench.report.text import axis_value

PLUGIN = re.compile(r"(\w+)\[([^\[\]]*=[^\[\]]*)\](.*)")
"""A plugin's name, its parameters and the rest of a part of a name: ``fobg[mirrored=true] (numpy)``."""
SETTING = re.compile(r"\w+=\S+")
METHODS = ("method", "estimator", "series")
"""Columns of methods, whose settings are not a matter of the chart: without one the name is another method's."""


def short_names(names: Iterable[str], is_whole: bool = False) -> dict[str, str]:
    """Return the short name of each name: its words, and of its parameters those that distinguish it from the others, or all.

    >>> def show(*names: str) -> None: print(*short_names(names).values(), sep="; ")
    >>> show("push, law, descent=0", "push, law, descent=0.9")
    push, law, at the start; push, law, after 90% of a descent
    >>> show("push, law", "push[hold=30,horizon=300], law")
    push, law; push, horizon 300, law
    >>> show("mjx[z=0.9]", "m[cone=elliptic,z=1]", "m[z=1]", "mjcf[file=gymnasium:envs/half_cheetah.xml,substeps=5]")
    mjx; m, cone elliptic; m; half cheetah
    >>> show("fobg", "fobg[mirrored=true]", "fobg (numpy)", "finite_difference[step=100000]", "finite_difference[step=10]")
    fobg; fobg, mirrored; fobg (numpy); finite difference, step 1e5; finite difference, step 10
    >>> show("gap [m]", "|dx_k+1 / dx_k|", "theta[0]", "first order, step 5 ms", "dt = 1/480 s")
    gap [m]; |dx_k+1 / dx_k|; theta[0]; first order, step 5 ms; dt = 1/480 s
    >>> show("a[descent=fast]", "a[descent=0.5]")
    a, descent fast; a, after 50% of a descent
    >>> show("a_b", "a b")
    a_b; a b
    >>> short_names(["smoothing[draws=orthogonal]"], is_whole=True)
    {'smoothing[draws=orthogonal]': 'smoothing, draws orthogonal'}
    """
    parsed = {name: _parts(name) for name in dict.fromkeys(names)}
    table = pd.DataFrame([*parsed.values()]).fillna("")
    words = [column for column in table if column[1] == ""]
    common = [column for name in IDENTITY for column in table if column[1] == name]
    ordered = dict.fromkeys([*words, *common, *table])
    kept = ordered if is_whole else distinguishing_columns(table, table.index.to_series(), ordered, words)
    order = sorted(kept, key=lambda column: column[0] or "last")
    short = [", ".join(filter(None, line)) for line in table[order].to_numpy()]
    return dict(zip(parsed, short if len(set(short)) == len(parsed) else parsed, strict=True))


def _parts(name: str) -> dict[tuple[str, str], str]:
    """Return the words of a name by their place, and its parameters by the place of their word and by their key, as texts."""
    found: dict[tuple[str, str], str] = {}
    for place, part in enumerate(re.split(r", (?![^\[]*\])", name)):
        plugin = PLUGIN.fullmatch(part)
        word, inside, rest = (
            plugin.groups() if plugin else ("", part, "") if SETTING.fullmatch(part) else (part, "", "")
        )
        for key, _, value in (one.partition("=") for one in inside.split(",") if inside):
            if key == "file":  # the model stands for the plugin that reads it
                word = PurePath(value.rpartition(":")[2]).stem
            else:
                found[str(place) * bool(word), key] = setting(key, value)
        if word:
            is_words = re.fullmatch(r"\w+( .*)?", word + rest)
            found[str(place), ""] = (word + rest).replace("_", " ") if is_words else word + rest
    return found


def setting(key: str, value: str) -> str:
    """Return a parameter as words: ``mirrored``, ``draws sobol``, ``after 90% of a descent``."""
    number = pd.to_numeric(value, errors="coerce")
    if key == "descent" and number == number:
        return f"after {number:.0%} of a descent" if number else "at the start"
    return f"{key} {axis_value(number) if number == number else value}".removesuffix(" true").replace("_", " ")


def in_words(chart: Chart) -> Chart:
    """Return a chart whose panels, series and categories have short names; its looks, notes and marks follow."""
    columns = dict.fromkeys((chart.panel, chart.series, *(c.name for c in (*chart.x, *chart.y) if c.kind == "text")))
    texts = [name for name in columns if name and not pd.api.types.is_numeric_dtype(chart.frame[name])]
    given = {name: chart.frame[name].fillna("").astype(str) for name in texts}
    short = {name: short_names(names, name in METHODS) for name, names in given.items()}
    frame = chart.frame.assign(**{name: given[name].map(names) for name, names in short.items()})
    series, panels = short.get(chart.series, {}), short.get(chart.panel, {})
    return replace(
        chart,
        frame=frame,
        styles={series.get(name, name): style for name, style in chart.styles.items()},
        panel_notes={panels.get(name, name): note for name, note in chart.panel_notes.items()},
        marks=[replace(mark, panel=panels.get(mark.panel or "", mark.panel)) for mark in chart.marks],
    )
