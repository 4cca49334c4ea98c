"""Searches whose ends are known: the order of three methods at fixed steps, and what a collision's gradient teaches."""

import pytest
from helpers import loaded

from bench.run.session import RunSession


def ends(*words):
    """The rows of an experiment's cells, in order."""
    made, cells = loaded(*words)
    session = RunSession(made)
    return [made.study.measure(cell, session) for cell in cells]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "known"),
    [
        (["contacts=[impulse,impulse[time_of_impact=false]]"], [1.395808, 2.0]),
        (["contacts=[impulse]", "integrators=[event_driven]"], [1.39911]),
    ],
)
def test_only_the_time_of_impact_teaches_two_balls_to_strike(words, known):
    """Within 1% of J* = 1.39654 with the time of impact; without it descent learns to do nothing, which costs 2."""
    found = ends(
        "scenes=[two_balls[horizon=480,dt=0.0020833333333333333,sigma=1e-12]]",
        "backends=[jax]",
        "samples=1",
        "name=balls",
        "study=optimise[iterations=120,quality=none,budget=100000000]",
        "estimators=[fobg]",
        "timing=false",
        "optimizers=[gradient_descent[rate=100]]",
        *words,
    )
    assert [one["final_cost"] for one in found] == pytest.approx(known, rel=2e-3)
