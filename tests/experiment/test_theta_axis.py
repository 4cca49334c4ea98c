"""Theta as an axis of a sweep: whole, or one coordinate of it."""

import numpy as np
import pytest
from helpers import loaded, rows_of

from bench.errors import UserError
from bench.experiment.axes import axes, with_axes
from bench.experiment.grid import cells

BASE = ("scenes=[quadratic]", "estimators=[reinforce]", "backends=[numpy]")
WHOLE = [(1.0, 0.0, 0.0, 0.0, 2.0), (3.0, 0.0, 0.0, 0.0, 4.0)]
WRITTEN = "sweep.theta0=[[1,0,0,0,2],[3,0,0,0,4]]"


def thetas(*words):
    return [tuple(cell.program().theta0.tolist()) for cell in loaded(*BASE, *words)[1]]


def test_whole_thetas_are_an_axis_whose_columns_are_the_coordinates_that_move():
    experiment, of = loaded(*BASE, WRITTEN)
    assert [tuple(cell.program().theta0) for cell in of] == WHOLE
    assert len({cell.key for cell in of}) == 2
    rows = rows_of(experiment, of)
    assert [axis.title for axis in axes(experiment.sweep, rows)] == [
        "theta0.0, and with it theta0.4",
        "theta0.4, and with it theta0.0",
    ]
    assert with_axes(experiment.sweep, rows)["theta0.4"].tolist() == [2.0, 4.0]


def test_one_coordinate_moves_and_the_others_stay():
    own = thetas()[0]
    assert thetas("sweep.theta0.1=[7,8]") == [(own[0], 7.0, *own[2:]), (own[0], 8.0, *own[2:])]
    assert thetas("theta0=[9,9,9,9,9]", "sweep.theta0.1=[7]") == [(9.0, 7.0, 9.0, 9.0, 9.0)]
    experiment, of = loaded(*BASE, "sweep.theta0.1=[7,8]", "sweep.theta0.0=[1,2]")
    assert [axis.column for axis in axes(experiment.sweep, rows_of(experiment, of))] == ["theta0.1", "theta0.0"]
    assert len(of) == 4


def test_a_single_number_is_the_whole_theta_of_one_variable():
    words = ("scenes=[heaviside]", *BASE[1:], "sweep.theta0=[-1,0,0.5]")
    experiment, of = loaded(*words)
    assert with_axes(experiment.sweep, rows_of(experiment, of))["theta0"].tolist() == [-1.0, 0.0, 0.5]
    # at the scene's own theta the closed form holds, elsewhere it is not claimed
    assert [cell.program().closed_form_gradient() is None for cell in of] == [True, False, True]


def test_theta_that_names_parameters_is_swept_too():
    words = ("theta=[condition]", "sweep.theta0=[2,3]")
    assert thetas(*words) == [(2.0,), (3.0,)]


def test_whole_thetas_and_coordinates_do_not_mix():
    experiment, _ = loaded(*BASE, WRITTEN)
    mixed = {"theta0": [WHOLE[0]], "theta0.1": [3.0]}
    with pytest.raises(UserError, match=r"theta0 and theta0\.1"):
        cells(type(experiment)(**{**vars(experiment), "sweep": mixed}))


def test_where_some_scenes_take_a_theta_the_others_say_so_in_their_rows():
    _, of = loaded("scenes=[quadratic,heaviside]", *BASE[1:], "sweep.theta0=[0.5]")
    assert [cell.refusal() and cell.refusal()[0] for cell in of] == ["unsupported", None]
    assert np.isfinite(of[1].program().theta0).all()
