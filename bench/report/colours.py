"""Returns looks by name: of an estimator the same in every chart, of other names the same in all charts of an experiment."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import count

import numpy as np
import pandas as pd

from bench.experiment.config import config_dir
from bench.experiment.views import Chart, Style
from bench.model import registry
from bench.report.style import VARIANTS, colour, marker

ORDER_OF_OTHERS = (7, 4, 3, 2, 1, 6, 5, 0)
"""Places in the palette of trainers and of searches by costs: first those that few estimators have, since both share charts."""


def looks_by_name(charts: Sequence[Chart]) -> dict[str, Style]:
    """Return the look of each series or level of some charts: a given one, that of its method, or a free colour each, in order."""
    columns = [(chart, chart.level if chart.kind == "grid" else chart.series) for chart in charts]
    names = (name for chart, column in columns for name in (chart.frame[column].unique() if column else [""]))
    drawn = dict.fromkeys(map(str, names))
    methods = {*order_of("estimators"), *searches()}
    given = method_styles(name for name in drawn if _plugin(name) in methods)
    given |= {name: style for chart in charts for name, style in chart.styles.items()}
    taken = {style.colour for style in given.values()}
    free = (place for place in count() if colour(place) not in taken)
    others = (name for name in drawn if name not in given)
    found = given | {name: Style(colour(i), marker(i)) for name, i in zip(others, free, strict=False)}
    return {name: style for name, style in found.items() if name in drawn}


def _plugin(method: str) -> str:
    """Return the name of the estimator or search of a method."""
    return re.split(r"[\[, ]", method)[0]


def graded(
    values: pd.Series, grades: Mapping[float, str], words: Callable[[str], str], unit: Callable[[float], str]
) -> tuple[pd.Series, dict[str, Style]]:
    """Return the grade of each value, and the look of each grade. ``grades`` are colours by upper end, the last of them infinite.

    ``words`` and ``unit`` format the ends: ``error below 10%``, ``error 100% or more``.
    """
    *ends, most = grades
    names = [*(words(f"below {unit(end)}") for end in ends), words(f"{unit(ends[-1])} or more")]
    place = np.searchsorted(ends, values.fillna(most), side="right")
    looks = {name: Style(colour) for name, colour in zip(names, grades.values(), strict=True)}
    return pd.Series(np.array(names, dtype=object)[place], values.index), looks


def estimator_style(estimator: str, variant: int = 0) -> Style:
    """Return the look of an estimator, a trainer or a search by costs, with a marker and dashes for each of its variants, from 0.

    Estimators have the colours of the palette in its order, the others in that of :data:`ORDER_OF_OTHERS`.
    """
    others, names = searches(), order_of("estimators")
    place = names.index(estimator) if estimator in names else len(names)
    if estimator in others:
        place = others.index(estimator)
        place = ORDER_OF_OTHERS[place] if place < len(ORDER_OF_OTHERS) else place
    return Style(colour(place), marker(place, variant), VARIANTS[variant % len(VARIANTS)])


def method_styles(methods: Iterable[str]) -> dict[str, Style]:
    """Return the look of each method, named by its estimator or search first: ``alpha_order[gamma=1], adam``."""
    looks: dict[str, Style] = {}
    uses: Counter[str] = Counter()
    for method in sorted(methods, key=lambda name: "[" in name):
        estimator = _plugin(method)
        looks[method] = estimator_style(estimator, uses[estimator])
        uses[estimator] += 1
    return looks


def searches() -> list[str]:
    """Return the optimizers that use costs only, which stand beside estimators, and the trainers."""
    optimizers = registry.entries()["optimizers"]
    alone = [name for name in order_of("optimizers") if getattr(optimizers[name].plugin, "needs", None) == {"value"}]
    return [*alone, *(name for name in order_of("trainers") if name not in alone)]


def order_of(kind: str) -> list[str]:
    """Return all registered plugins of a kind, those of most of the package's experiments first.

    The first colours of the palette differ most, so they belong to the plugins that are compared most often.
    """
    uses = _uses()
    return sorted(registry.entries()[kind], key=lambda name: (-uses[name], name))


@cache
def _uses() -> Counter[str]:
    """Return in how many of the package's experiments each word occurs."""
    paths = sorted((config_dir() / "experiment").glob("*.yaml"))
    return Counter(word for path in paths for word in set(re.findall(r"\w+", path.read_text(encoding="utf-8"))))
