"""Compilations in a sweep over parameters that change no shape."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from bench.benchself.lines import Line
from bench.benchself.rollouts import batch, problem
from bench.contracts import compilations

FACTORS = (0.5, 1.0, 2.0)


def lines(settings: Mapping[str, Any]) -> Iterator[Line]:
    """How many programs a sweep of parameters compiles; as many as it has shapes are wanted."""
    backend, chosen = settings["subjects"][0]["backend"], settings["sweep"]
    points = list(itertools.product(FACTORS, repeat=len(chosen["parameters"])))
    compilations.restart()
    for point in points:
        scale = dict(zip(chosen["parameters"], point, strict=True))
        made = problem(settings, backend, chosen["contact"], scale)
        w, theta = batch(made, 64), made.program.scene.theta0()
        made.value(theta, w)
        made.grad(theta, w)
    what = f"compilations over {len(points)} values of {' x '.join(chosen['parameters'])}"
    yield Line(what, compilations.made, "", len(compilations.shapes), note="target: distinct shapes")
