"""Counts compilations in a sweep over parameters that change no shape."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from bench.benchself.lines import SpeedRow
from bench.benchself.rollouts import batch, problem
from bench.model import Compilations

FACTORS = (0.5, 1.0, 2.0)


def lines(settings: Mapping[str, Any]) -> Iterator[SpeedRow]:
    """Return how many programs a sweep of parameters compiles; the target is the number of shapes."""
    backend, chosen = settings["subjects"][0]["backend"], settings["sweep"]
    points = list(itertools.product(FACTORS, repeat=len(chosen["parameters"])))
    compilations = Compilations()
    for point in points:
        scale = dict(zip(chosen["parameters"], point, strict=True))
        compiled = problem(settings, backend, chosen["contact"], scale)
        compiled.compilations = compilations
        w, theta = batch(compiled, 64), compiled.program.theta0
        compiled.value(theta, w)
        compiled.grad(theta, w)
    what = f"compilations over {len(points)} values of {' x '.join(chosen['parameters'])}"
    yield SpeedRow(what, compilations.made, "", len(compilations.shapes), note="target: distinct shapes")
