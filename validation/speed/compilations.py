"""Counts compilations in a sweep over parameters that do not change array shapes."""

import itertools

from bench.model import Compilations
from speed.rollouts import batch, problem
from speed.speed_rows import SpeedRow

FACTORS = (0.5, 1.0, 2.0)
"""Factors by which each parameter is multiplied."""


def count_compilations(settings):
    """Yield one row: the number of programs that a sweep compiles, with the number of distinct shapes as target."""
    backend, swept = settings["subjects"][0]["backend"], settings["sweep"]
    points = list(itertools.product(FACTORS, repeat=len(swept["parameters"])))
    compilations = Compilations()
    for point in points:
        scale = dict(zip(swept["parameters"], point, strict=True))
        compiled = problem(settings, backend, swept["contact"], scale)
        compiled.compilations = compilations
        w, theta = batch(compiled, 64), compiled.program.theta0
        compiled.value(theta, w)
        compiled.grad(theta, w)
    what = f"compilations over {len(points)} values of {' x '.join(swept['parameters'])}"
    yield SpeedRow(what, compilations.made, "", len(compilations.shapes), note="target: distinct shapes")
