"""Searches whose ends are known: what a collision's gradient teaches."""

import pytest

from bench.experiment import config
from bench.experiment.grid import cells
from bench.experiment.study import study_of
from bench.run.session import Session


def ends(*words):
    """The rows of an experiment's cells, in order."""
    made = config.load(list(words))
    session = Session(made)
    return [study_of(made).measure(cell, session) for cell in cells(made)]


@pytest.mark.slow
def test_only_the_time_of_impact_teaches_two_balls_to_strike():
    """Within 1% of J* with the time of impact; without it descent learns to do nothing, which costs 2."""
    with_it, without = ends(
        "scenes=[two_balls[horizon=480,dt=0.0020833333333333333,sigma=1e-12]]", "backends=[jax]", "samples=1", "name=balls",
        "study=optimise[iterations=120,quality=none,budget=100000000]", "estimators=[fobg]", "timing=false",
        "optimizers=[gradient_descent[rate=100]]", "contacts=[impulse,impulse[time_of_impact=false]]",
    )  # fmt: skip
    assert with_it["final_cost"] == pytest.approx(1.39654216, rel=0.01)
    assert with_it["final_cost"] == pytest.approx(1.395808, rel=1e-3)
    assert without["final_cost"] == pytest.approx(2.0, rel=0.001)


@pytest.mark.slow
def test_the_event_driven_integrator_teaches_two_balls_to_strike_too():
    (found,) = ends(
        "scenes=[two_balls[horizon=480,dt=0.0020833333333333333,sigma=1e-12]]", "backends=[jax]", "samples=1", "name=events",
        "study=optimise[iterations=120,quality=none,budget=100000000]", "estimators=[fobg]", "timing=false",
        "optimizers=[gradient_descent[rate=100]]", "contacts=[impulse]", "integrators=[event_driven]",
    )  # fmt: skip
    assert found["final_cost"] == pytest.approx(1.39911, rel=2e-3)
