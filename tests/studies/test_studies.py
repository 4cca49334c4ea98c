"""What studies show of rows: nothing is folded that has parameters of its own, and every row says how to make it again."""

import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
from bench.plugins.studies.gradient_check import views as gradient_check
from bench.plugins.studies.stability import cells_of
from bench.plugins.studies.twins import FLOOR
from helpers import unmeasured

import bench
from bench.experiment import config
from bench.experiment.columns import COMMON
from bench.experiment.grid import cells
from bench.gradient import EPS
from bench.model import registry
from bench.report import reproduce
from bench.report.cells import readable
from bench.report.finish import views_of
from bench.report.problems import problem_numbers
from bench.report.views import arrange
from bench.report.web.data import page_data

SPRUNG = '''
from dataclasses import dataclass

from bench.model import param
from bench.plugins.scenes.bouncing_ball import BouncingBall


@dataclass(frozen=True)
class Sprung(BouncingBall):
    """A ball with a spring of its own beside the contact's."""

    name = "sprung"
    stiffness: float = param(1.0, "stiffness of a spring of its own", "N/m", low=0.0)
'''
COUNTED = '''
from dataclasses import dataclass
from typing import ClassVar

from bench.experiment.columns import Column, Columns, ComparisonRule, text
from bench.experiment.study import Study


@dataclass(frozen=True)
class Counted(Study):
    """A study without a page of its own."""

    name = "counted"
    columns: ClassVar[Columns] = Columns.of(
        Column("weight", "how heavy it is", "kg"),
        text("outcome", "how it ended", comparison=ComparisonRule("verdict", "outcome", order=("bad", "good"))),
    )

    def measure(self, cell, session):
        return {"status": "ok", "weight": 1.0, "outcome": "good"}
'''


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A folder with a scene that has a stiffness of its own and a study without a page."""
    folder = tmp_path_factory.mktemp("own plugins")
    for kind, name, code in (("scenes", "sprung", SPRUNG), ("studies", "counted", COUNTED)):
        (folder / kind).mkdir()
        (folder / kind / f"{name}.py").write_text(code)
    return folder


# -------------------------------------------------------------------------------------------------- gradient_check


def checked(*words):
    given, rows = unmeasured("study=gradient_check", "backends=[jax,torch]", "estimators=[fobg]", *words)
    eps = EPS[:2]
    values = {
        "point": ["start"],
        "sample": [0],
        "direction": [0],
        "derivative_program": [1.0],
        "check_verdict": ["smooth"],
        "check_error": [1e-9],
        "check_eps": [1e-4],
        "eps": list(eps),
        "derivative_differences": [1.0, 1.0],
        "relative_error": [1e-9, 1e-8],
        "mode_minus": ["", ""],
        "mode_plus": ["", ""],
    } | {name: [0] for name in gradient_check.PER_COMPONENT}
    given = replace(given, plugins=())  # of another test in this process
    return given, rows.assign(verdict="smooth", **{name: [value] * len(rows) for name, value in values.items()})


def test_a_swept_parameter_keeps_lines_of_the_gradient_check_apart():
    given, rows = checked("scenes=[mass_spring]", "sweep.mass_spring.damping=[0,1,10]", "sweep.horizon=[2]")
    shown = gradient_check.views(given, rows)
    found = readable(shown.tables[1])
    assert list(found["damping"]) == ["0", "1", "10"]
    assert set(found["scene"]) == {"mass_spring"}
    (grid,) = shown.charts
    assert list(grid.frame["name"]) == [f"mass_spring, damping={c}, 2 steps" for c in (0, 1, 10)]
    assert list(grid.frame["letter"]) == ["ok"] * 3
    assert set(grid.frame["steps"]) == {""}, "one horizon is named with the problem"


def test_untrusted_undecided_and_missing_gradients_come_first_and_are_never_right():
    given, rows = checked("scenes=[pendulum]", "sweep.horizon=[1,2]")
    rows["command"] = [f"python -m bench gradcheck {i}" for i in range(len(rows))]
    rows.at[0, "check_verdict"], rows.at[0, "check_error"] = ["wrong_factor"], [0.5]
    rows.at[1, "check_verdict"], rows.at[1, "check_error"] = ["nonfinite"], [np.nan]
    shown = gradient_check.views(given, rows)
    verdicts = shown.tables[0].frame.set_index("verdict")
    assert verdicts.loc[["wrong_factor", "nonfinite"], "trusted"].tolist() == ["no", "no"]
    assert list(shown.charts[0].frame["letter"]) == ["X", "ok"], "the worse verdict of the backends"
    assert "      python -m bench gradcheck 0" in shown.tables[1].notes


# ------------------------------------------------------------------------------------------------------- stability


def mapped(*words):
    words = ("study=stability", "backends=[jax]", "estimators=[fobg]", *words)
    return unmeasured(*words, verdict="ok", truth="physical", growth_factor=1.0)


@pytest.mark.parametrize(
    ("words", "maps"),
    [
        (
            [
                "scenes=[mass_spring]",
                "sweep.zip.dt=[0.1,0.05]",
                "sweep.zip.horizon=[10,20]",
                "sweep.mass_spring.damping=[0,1]",
            ],
            ["mass_spring, damping=0", "mass_spring, damping=1"],
        ),
        # a swept number that equals a stiffness
        (
            ["scenes=[mass_spring]", "sweep.mass_spring.damping=[10,100]"],
            ["mass_spring, damping=10", "mass_spring, damping=100"],
        ),
        # sigma has a column of its own, and so is in no identity string
        (
            ["scenes=['mass_spring[sigma=0.1]','mass_spring[sigma=0.2]']"],
            ["mass_spring, sigma=0.1", "mass_spring, sigma=0.2"],
        ),
    ],
)
def test_maps_are_apart_by_parameters(words, maps):
    given, rows = mapped("sweep.stiffness=[10,100]", *words)
    cells = cells_of(given, rows)
    assert list(dict.fromkeys(cells["problem"])) == maps
    for _, part in cells.groupby(["problem", "dt"]):
        assert sorted(part["stiffness"]) == [10.0, 100.0]
    [first] = given.study.views(given, rows).charts
    assert set(first.frame["problem"]) == {maps[0]}


# ----------------------------------------------------------------------------------------------------------- twins


def test_twins_of_a_swept_scene_are_panels_of_their_own():
    given, rows = unmeasured(
        "study=twins", "scenes=[pendulum]", "backends=[mujoco,mjx]", "estimators=[fobg]", "sweep.horizon=[2,3]"
    )
    rows = rows.assign(
        gradient_difference_rel=[0.0, 2e-3, 1e-3, 1e-3], cost_difference_rel=0.0, state_difference_rel=1e-3
    )
    shown = given.study.views(given, rows)
    [chart], [lines] = shown.charts, shown.tables
    assert list(chart.frame["problem"].unique()) == ["pendulum, horizon=2", "pendulum, horizon=3"], "the worst is first"
    assert chart.x[0].least == FLOOR, "0 is at the lower edge"
    assert list(readable(lines)["horizon [steps]"]) == ["2", "2", "3", "3"]


def of_a_robot(study, backend, folder):
    """Return the row of a study on a robot's own file."""
    parts = {
        "scenes": ["mjcf[file=cube.xml,theta=velocity,noise=parameter]"],
        "contacts": ["penalty"],
        "estimators": ["plain"],
    }
    counts = {"samples": 2, "repeats": 2, "reference": {"samples": 256}, "workers": 0}
    return bench.run(study=study, name="own", backends=[backend], results_dir=folder, **parts, **counts).iloc[0]


def test_two_engines_on_a_robot_part_in_a_step_and_none_is_compared_with_itself(tmp_path):
    row = of_a_robot("twins", "mujoco[cone=elliptic]", tmp_path)
    assert row["reason"].startswith("the engines part in step ")
    assert "no backend but mujoco" in of_a_robot("twins", "mujoco", tmp_path)["reason"]


def test_a_robot_has_a_program_error_and_no_physics_to_compare_with(tmp_path):
    row = of_a_robot("three_errors", "mujoco", tmp_path)
    assert row["program_error_rel"] < 1e-6
    assert np.isnan(row["model_error_rel"])


# ------------------------------------------------------------------------------------------------------ swept axes


def test_a_scene_with_a_stiffness_of_its_own_keeps_its_cells_apart(own):
    words = [f"plugins=['{own}']", "scenes=[sprung]", "contacts=[penalty]", "estimators=[fobg]"]
    given, rows = unmeasured(*words, "sweep.sprung.stiffness=[1,10,100]")
    assert problem_numbers(rows, ["scene"]).nunique() == 3
    shown = arrange(given, rows)
    (axis,) = shown.axes
    assert sorted(shown.rows[axis.column]) == [1.0, 10.0, 100.0]
    assert axis.unit == "N/m"
    assert rows["stiffness"].nunique() == 1  # that of the law
    given, rows = mapped(*words, "sweep.sprung.stiffness=[1,10,100]", "sweep.penalty.stiffness=[1,10]")
    maps = cells_of(given, rows).groupby("problem")
    assert [list(cells["stiffness"]) for _, cells in maps] == [[1.0, 10.0]] * 3


# ----------------------------------------------------------------------------------------------------------- pages


def test_a_study_without_a_page_gets_its_numbers_and_filters_by_what_varies(own):
    words = [f"plugins=['{own}']", "study=counted", "scenes=[mass_spring]", "estimators=[fobg]", "sweep.mass=[1,2,3]"]
    given, rows = unmeasured(*words)
    rows = rows.assign(weight=[1.0, 2.0, 30.0], outcome=["good", "bad", "good"])
    views = views_of(given, rows)
    data = page_data(given, rows, views, [[]] * 3)
    assert [(chart.x[0].name, chart.y[0].heading) for chart in views.charts] == [("mass", "weight [kg]")]
    assert data["filters"] == ["mass", "outcome"]
    assert data["cells"]["mass"] == [1, 2, 3]


# ---------------------------------------------------------------------------------------------------------- again


def again(given, rows, command):
    """The keys of the cells that a command line runs, with the budget of references that the rows have, if any."""
    words = shlex.split(" ".join([reproduce.HEAD, *command]))
    assert words[:3] == ["python", "-m", "bench"]
    found = config.load(words[3:])
    every = cells(found)
    assert all(cell.budget is None or found.reference == given.reference for cell in every)
    return [cell.key for cell in every]


def one_a_study():
    """The first standard experiment of each study."""
    found = {}
    for name in config.experiments():
        text = (config.config_dir() / "experiment" / f"{name}.yaml").read_text()
        study = re.search(r'^study: *"?(\w+)', text, re.MULTILINE)
        found.setdefault(study[1] if study else "bias_variance", name)
    return list(found.values())


@pytest.fixture(scope="module", params=one_a_study())
def standard(request):
    return unmeasured(f"experiment={request.param}")


def test_a_standard_experiment_of_each_study_says_how_its_rows_are_made_again(standard):
    given, rows = standard
    commands = reproduce.commands(given, rows)
    assert all(commands)
    assert len(set(map(tuple, commands))) == len(rows)
    for place in np.linspace(0, len(rows) - 1, 3).astype(int):
        assert again(given, rows, commands[place]) == [rows["key"][place]]


@pytest.mark.parametrize(
    "words",
    [
        ["scenes=[pushing]", "timing=false", "sweep.stiffness=[10,1e6]"],
        ["study=stability[inaccurate=0.25,fine_steps=64]", "scenes=[mass_spring]", "timing=true"],
        ["scenes=[mass_spring]", "theta=[mass,stiffness]", "theta0=[0.5,20]", "sweep.sigma=[0.01,0.02]"],
        ["scenes=[pushing]", "theta=[mass]", "reference.samples=512", "reference.tolerance=0.1", "sweep.seed=[0,7]"],
        ["scenes=[wall_penalty_1d,bouncing_ball]", "contacts=[penalty]", "sweep.damping=[0,1]", "sweep.samples=[8,16]"],
        ["scenes=[wall_penalty_1d]", "contacts=[penalty]", "sweep.stiffness=[50,1e4]"],
        ["scenes=[quadratic]", "backends=['numpy','jax[dtype=float32]']"],
    ],
)
def test_whatever_decides_a_cell_is_in_its_command(words):
    given, rows = unmeasured(*words)
    for command, key in zip(reproduce.commands(given, rows), rows["key"], strict=True):
        assert again(given, rows, command) == [key]


def test_the_command_of_a_cell_names_the_folders_of_its_plugins(own):
    given, rows = unmeasured(f"plugins=['{own}']", "scenes=['sprung[stiffness=3]']", "study=counted")
    (command,) = reproduce.commands(given, rows[:1])
    assert any(str(own) in word for word in command)
    assert again(given, rows, command) == [rows["key"][0]]


def test_a_row_of_a_plugin_that_is_not_installed_has_no_command():
    given, rows = unmeasured("scenes=[pushing]")
    rows["parameters"] = rows["parameters"].str.replace('"name":"pushing"', '"name":"gone"')
    assert reproduce.commands(given, rows) == [[]] * len(rows)
    assert views_of(given, rows).tables


@pytest.mark.parametrize(
    "words",
    [
        ["scenes=['bouncing_ball[dt=0.02]']", "contacts=['penalty[stiffness=500]']", "sweep.horizon=[7]", "seed=3"],
        ["scenes=[pushing]", "study=gradient_check[reach=3]", "theta=[mass]", "sweep.horizon=[5]"],
        ["scenes=[pendulum]", "sweep.horizon=[1]"],
    ],
)
def test_the_command_of_a_gradient_check_repeats_its_cell(words):
    given = config.load(["experiment=gradient_check", "backends=[jax]", "integrators=[rk4]", *words])
    cell = cells(given)[0]
    head, verb, scene, *rest = shlex.split(reproduce.check_of(cell).removeprefix("python -m "))
    assert (head, verb) == ("bench", "gradcheck")
    assert "=" not in scene.partition("[")[0]
    found = cells(config.load(["experiment=gradient_check", f"scenes=[{scene}]", *rest]))
    assert [other.key for other in found] == [cell.key]


def test_cells_without_results_are_said_so(standard):
    given, rows = standard
    shown = given.study.views(given, rows.head(12).assign(status="unsupported", reason="planted"))
    assert not shown.charts
    assert shown.remarks == [f"{min(len(rows), 12)} unsupported: planted"]


@pytest.mark.parametrize("name", sorted(registry.entries()["studies"]))
def test_times_and_memory_are_declared_to_depend_on_the_machine(name):
    """So that rows of cells without timing have the same bits wherever they are computed."""
    study = registry.usable("studies", name)
    own = [column for column in study.columns.all if column.name not in COMMON and column.format != "setting"]
    assert [column.name for column in own if column.unit in ("s", "MB", "MiB") and not column.measured] == []
