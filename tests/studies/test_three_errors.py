"""Program, model and estimator error kept apart: the impulse without time of impact, which only the model error betrays."""

import numpy as np
import pytest
from bench.plugins.studies.three_errors import OWN, PARTS, TRAP, _signs, difference_check, traps
from classes import BouncingBall, Impulse, Jax, SemiImplicitEuler
from helpers import unmeasured

from bench.model import compose
from bench.report.shown import Shown


def test_a_wrong_derivative_is_seen():
    class Wrong:
        def __init__(self, problem):
            self.program, self.value = problem.program, problem.value
            self.grad = lambda *at: -problem.grad(*at)

    problem = Jax().compile(compose(BouncingBall(horizon=50), Impulse(), SemiImplicitEuler()))
    _, gradient, difference, _ = difference_check(Wrong(problem))
    assert np.linalg.norm(gradient - difference) == pytest.approx(2 * np.linalg.norm(gradient))


@pytest.mark.parametrize(
    ("change", "trapped"),
    [
        ({}, True),
        ({"program_error_rel": [1e-12, 1e-3]}, False),
        ({"model_cosine": [-0.5, 0.1]}, False),
        ({"model_cosine": [0.38, 0.38], "model_error_rel": [1.05, 1.05]}, True),
        ({"model_cosine": [0.85, 0.85], "model_error_rel": [0.74, 0.74]}, True),
        ({"model_cosine": [0.9, 0.99], "model_error_rel": [0.74, 0.2]}, False),
        ({"model_cosine": [0.99, 0.99], "model_error_rel": [0.02, 0.02]}, False),
        ({"forward_error_rel": [0.4, 0.3]}, False),
        ({"forward_error_rel": [0.4, np.nan]}, False),
        ({"program_error_rel": [1e-12, np.nan]}, False),
        ({"model_cosine": [np.nan, np.nan], "model_error_rel": [np.nan, np.nan]}, False),
    ],
)
def test_a_trap_is_exact_convergent_and_turned_away_or_no_nearer_at_every_step(change, trapped):
    words = [
        "study=three_errors",
        "scenes=[bounce_once]",
        "contacts=[impulse]",
        "backends=[jax]",
        "sweep.dt=[0.1,0.05]",
    ]
    values = {"program_error_rel": [1e-12, 1e-13], "model_cosine": [-0.5, -0.4], "forward_error_rel": [0.4, 0.1]}
    values |= {"model_error_rel": [1.5, 0.5]}
    given, typed = unmeasured(*words, "estimators=[fobg]", **(values | change))
    assert len(traps(Shown(given, typed, ["dt"], ["estimator"], PARTS))) == 3 * trapped
    found = given.study.show(given, typed)
    assert (set(found.charts[0].frame["series"]) == {OWN, TRAP}) == trapped


def test_rounding_has_no_sign():
    assert list(_signs(np.array([-7e-16, 0.4, -1e-3]))) == [0.0, 1.0, -1.0]
