"""An estimator, scenes and a study written for the last version still run, and warnings give the new names."""

import importlib
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

import bench
from bench import deprecated, errors, notebook
from bench.model import Descent, Estimator, FunctionScene, SampleMean, sources

ESTIMATOR = '''
"""First order with a weight that it reports."""
from dataclasses import dataclass
import numpy as np
from bench import SampleMean

@dataclass(frozen=True)
class Old(SampleMean):
    """Approximates grad J_sigma. Requires gradients."""
    name = "old"
    needs = frozenset({"grad"})
    across_jumps = True
    adds_explicit = True
    reports = ("weight",)

    def terms(self, problem, theta, w):
        return problem.grad(theta, w)

    def estimate(self, problem, theta, noise):
        return self.explained(problem, theta, noise)[0]

    def explained(self, problem, theta, noise):
        return SampleMean.estimate(self, problem, theta, noise), {"weight": np.full(len(noise), 0.25)}

    def refuses(self, program):
        if program.scene.name == "quadratic":
            return "old refuses quadratic"
        return super().refuses(program)
'''
SCENE = '''
"""Scenes of roles that have new names."""
from dataclasses import dataclass
import numpy as np
from bench import GustyScene, HeldScene, State, param

class Cart:
    """What both have in common."""
    leaves_out = "friction"
    n_q = 1
    n_u = 1

    def theta0(self):
        return np.ones(self.controls if self.open_loop else 1)

    def initial_state(self, xp, theta):
        return State(0.0 * theta[:1], 0.0 * theta[:1])

    def acceleration(self, xp, q, v, u):
        return u

    def terminal_cost(self, xp, q, v):
        return (q[0] - 1) ** 2

@dataclass(frozen=True)
class Windy(Cart, GustyScene):
    """A cart in the wind."""
    name = "windy"
    horizon: int = param(4, "steps")

    def planned_controls(self, xp, theta):
        return xp.broadcast_to(theta[None, :1], (self.horizon, 1, theta.shape[1]))

@dataclass(frozen=True)
class Held(Cart, HeldScene):
    """A cart whose controls are held."""
    name = "held"
    open_loop = True
    leaves_out = "air"
    horizon: int = param(4, "steps")
    hold: int = param(2, "steps")
'''
STUDY = '''
"""How long is the gradient?"""
from dataclasses import dataclass
import numpy as np
from bench import Judged
from bench.sweep.axes import table
from bench.sweep.cell import Cell
from bench.sweep.columns import Column, Columns
from bench.sweep.experiment import Experiment
from bench.sweep.files import write_all
from bench.sweep.session import Session
from bench.sweep.study import Study

@dataclass(frozen=True)
class Norm(Study):
    """Measures the norm of the gradient at theta, without noise."""
    name = "norm"
    axes = ("scene", "contact", "integrator", "backend")
    columns = Columns.of(Column("norm", "norm of the gradient", judged=Judged("exact", "norm")))

    def refuses(self, cell):
        return "norm refuses linear" if cell.scene.name == "linear" else super().refuses(cell)

    def measure(self, cell: Cell, session: Session):
        problem = session.problem(cell)
        gradient = problem.grad(problem.program.theta0, np.zeros((problem.program.n_noise, 1)))
        return {"status": "ok", "reason": "", "norm": float(np.linalg.norm(gradient))}

    def write(self, experiment: Experiment, rows):
        text = table(experiment, rows).to_csv(index=False, lineterminator="\\n")
        return write_all(experiment.directory, {"norm.csv": text})
'''


@pytest.fixture(autouse=True)
def forgotten_modules(monkeypatch):
    """A module warns when it is first imported under its old name: none of them has been."""
    for name in list(sys.modules):
        if any(f"{name}.".startswith(f"{old}.") for old in deprecated.MODULES):
            monkeypatch.delitem(sys.modules, name)


@pytest.fixture
def settings(tmp_path):
    """A folder of plugins as the last version documented them, and where their rows go."""
    (tmp_path / "mine").mkdir()
    for name, text in (("estimator", ESTIMATOR), ("scene", SCENE), ("study", STUDY)):
        (tmp_path / "mine" / f"{name}.py").write_text(text)
    common = {"integrators": ["semi_implicit_euler"], "backends": ["numpy"], "workers": 1}
    return common | {"plugins": str(tmp_path / "mine"), "results_dir": str(tmp_path / "out"), "name": "mine"}


def messages(caught):
    return "\n".join(str(one.message) for one in caught if one.category is DeprecationWarning)


@pytest.mark.slow
def test_an_old_estimator_runs_on_old_scenes(settings):
    with pytest.warns(DeprecationWarning, match="is now called") as caught:
        rows = bench.run(
            scenes=["windy", "held", "quadratic"], estimators=["fobg", "old"], samples=8, repeats=4, **settings
        )
    rows = rows.set_index(["scene", "estimator"])
    for scene in ("windy", "held"):
        assert (rows.loc[[(scene, "fobg"), (scene, "old")], "status"] == "ok").all()
        assert rows.loc[(scene, "old"), "rmse"] == rows.loc[(scene, "fobg"), "rmse"]
    assert '"weight"' in str(rows.loc[("held", "old"), "auxiliaries"])
    assert tuple(rows.loc[("quadratic", "old"), ["status", "reason"]]) == ("unsupported", "old refuses quadratic")
    said = messages(caught)
    for old, new in (
        ("bench.SampleMean", "bench.plugin.SampleMean"), ("bench.GustyScene", "bench.plugin.ProcessNoiseScene"),
        ("bench.HeldScene", "bench.plugin.ZeroOrderHoldScene"),
        ("Windy.leaves_out", "neglected_effects"), ("Held.leaves_out", "neglected_effects"),
        ("Old.across_jumps", "unbiased_at_discontinuities"), ("Old.adds_explicit", "includes_explicit_derivative"),
        ("Old.reports", "diagnostics"), ("Old.explained", "estimate_with_diagnostics"),
        ("Old.refuses", "unsupported_reason"),
    ):  # fmt: skip
        assert f"{old} is now called {new};" in said
    places = {one.filename.rpartition("/")[2] for one in caught if "is now called" in str(one.message)}
    assert places <= {"estimator.py", "scene.py", "study.py"}  # the author's own files


def test_an_old_study_runs(settings):
    with pytest.warns(DeprecationWarning, match="is now called") as caught:
        rows = bench.run(study="norm", scenes=["held", "linear"], **settings).set_index("scene")
    assert rows.loc["held", "norm"] > 0
    assert rows.loc["linear", "reason"] == "norm refuses linear"
    said = messages(caught)
    for old, new in (
        ("bench.sweep.axes", "bench.experiment.axes"), ("bench.sweep.files", "bench.run.files"),
        ("bench.Judged", "bench.plugin.ComparisonRule"), ("Column(judged=...)", "comparison"),
        ("Norm.refuses", "unsupported_reason"),
    ):  # fmt: skip
        assert f"{old} is now called {new};" in said


def test_an_overridden_member_reaches_that_of_its_base_by_the_old_name():
    with pytest.warns(DeprecationWarning, match="First.refuses is now called unsupported_reason"):

        @dataclass(frozen=True)
        class First(SampleMean):
            def terms(self, problem, theta, w):
                return w

            def refuses(self, program):
                return "first"

    with pytest.warns(DeprecationWarning, match="Second.refuses is now called unsupported_reason"):

        class Second(First):
            def refuses(self, program):
                return f"second after {super().refuses(program)}"

    class Third(Second):
        def unsupported_reason(self, program):
            return f"third after {super().unsupported_reason(program)}"

    with pytest.warns(DeprecationWarning, match="Second.refuses"):
        assert Second().unsupported_reason(None) == "second after first"
    with pytest.warns(DeprecationWarning, match="Third.refuses"):
        assert Third().refuses(None) == "third after second after first"


def test_members_are_read_by_their_old_names_from_classes_and_instances():
    class Now(Estimator):
        diagnostics = ("weight",)

        @property
        def unbiased_at_discontinuities(self):
            return "a property"

        def estimate(self, problem, theta, noise):
            return noise

    for plugin in (Now, Now()):
        with pytest.warns(DeprecationWarning, match="Now.reports is now called diagnostics"):
            assert plugin.reports == ("weight",)
    with pytest.warns(DeprecationWarning, match="unbiased_at_discontinuities"):
        assert Now().across_jumps == "a property"


def test_an_old_optimizer_names_the_fields_of_the_next_step():
    with pytest.warns(DeprecationWarning, match="Old.wants is now called required_fields"):

        class Old(Descent):
            def step(self, state, gradient):
                return state

            def wants(self, state):
                return frozenset()

    assert Old().required_fields({}) == frozenset()


def test_a_renamed_function_is_found_by_its_old_name():
    with pytest.warns(DeprecationWarning, match="bench.simulator_of is now called bench.plugin.load_simulator"):
        assert bench.simulator_of is bench.plugin.load_simulator


def test_a_name_that_bench_had_is_found_where_it_is_now():
    for name in [*bench.plugin.__all__, *deprecated.HOMES]:
        if name not in bench.__all__:
            with pytest.warns(DeprecationWarning, match=rf"bench\.{name} is now called bench\.\w+\.{name};"):
                assert getattr(bench, name) is not None
    with pytest.warns(DeprecationWarning, match="is now called"):
        from bench import Estimates, Report, StorageError
    assert (Estimates, StorageError) == (notebook.Estimates, errors.StorageError)
    assert isinstance(bench.examine(lambda x: x[0] ** 2, [1.0], progress=False, budget=2), Report)


def test_an_old_name_that_the_kind_never_had_is_the_authors_own():
    class Bowl(FunctionScene):
        reports = "its own"

        def theta0(self):
            return np.zeros(1)

        def cost(self, xp, x):
            return x[0] ** 2

    assert Bowl.reports == "its own"
    assert not hasattr(Bowl, "diagnostics")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("bench.face", "bench.api"),
        ("bench.model.known", "bench.model.known_solutions"),
        ("bench.model.loaded", "bench.model.simulator.imports"),
        ("bench.simulator.mjcf", "bench.model.simulator.mjcf"),
        ("bench.simulator.layout", "bench.model.simulator.tree"),
        ("bench.sweep.grid", "bench.experiment.grid"),
        ("bench.sweep.store", "bench.run.store"),
    ],
)
def test_a_module_by_its_old_name_is_the_new_one(old, new):
    with pytest.warns(DeprecationWarning, match="is now called") as caught:  # of the package too
        assert importlib.import_module(old) is importlib.import_module(new)
    assert f"{old} is now called {new};" in messages(caught)
    assert sources.file_of(old) == sources.file_of(new)


def test_a_module_that_never_was_is_not_found():
    with pytest.warns(DeprecationWarning, match="bench.sweep is now called"), pytest.raises(ModuleNotFoundError):
        importlib.import_module("bench.sweep.never")
    with pytest.raises(AttributeError, match="module 'bench' has no attribute 'Never'"):
        bench.Never  # noqa: B018


def test_nothing_in_the_package_uses_an_old_name():
    code = "import bench.cli, bench.conformance; from bench.model import registry; registry.entries()"
    done = subprocess.run([sys.executable, "-W", "error::DeprecationWarning:bench", "-c", code], capture_output=True)
    assert done.returncode == 0, done.stderr
