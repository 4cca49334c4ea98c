"""A ladder of scenes: a rung starts when the checks of the rung below pass, and the run says how far it came."""

import pandas as pd
import pytest
from trees import Tree

from bench.cli import main
from bench.experiment import config
from bench.report.finish import views_of
from bench.run.execute import store_of

FORGETFUL = '''
from dataclasses import dataclass

from bench.plugin import Backend, param
from bench.plugins.backends.numpy import NumpyProblem


@dataclass(frozen=True)
class NAME(Backend):
    """Differences, without a term on one scene."""

    name = "NAME"
    forgets: str = param("SCENE", "scene whose gradient lacks a term")

    def compile(self, program):
        """Return the problem."""
        return Forgetful(program, self.dtype, 1e-6, program.scene.name == self.forgets)


class Forgetful(NumpyProblem):
    """A problem without a term of the gradient."""

    def __init__(self, program, dtype, step, forgets):
        super().__init__(program, dtype, step)
        self._forgets = forgets

    def _grad(self, theta, w):
        gradient = super()._grad(theta, w)
        if self._forgets:
            gradient[0] = 0.0
        return gradient
'''
SCENES = ["double_integrator", "pendulum", "cartpole", "mass_spring"]
WORDS = [
    "name=climb",
    "study=gradient_check[directions=1,drawn=2,around=1]",
    f"scenes=[{','.join(SCENES)}]",
    "estimators=[fobg]",
    "sweep.horizon=[3]",
    "ladder=true",
    "workers=0",
    "formats=[]",
]


def backend(name, scene):
    return FORGETFUL.replace("NAME", name).replace("SCENE", scene)


@pytest.fixture(scope="module")
def climbed(tmp_path_factory):
    """The words and the experiment of a climb with a fault on the second of four rungs, for one of two backends."""
    folder = tmp_path_factory.mktemp("climb")
    (folder / "plugins").mkdir()
    (folder / "plugins" / "forgetful_climber.py").write_text(backend("forgetful_climber", "pendulum"))
    words = [
        *WORDS,
        "backends=[forgetful_climber,numpy]",
        f"plugins={folder / 'plugins'}",
        f"results_dir={folder / 'out'}",
    ]
    assert main(words) == 0
    return words, config.load(words)


def statuses(experiment, backend):
    rows = store_of(experiment).load()
    rows = rows[rows["backend"] == backend]
    return dict(zip(rows["scene"], rows["status"], strict=True))


def test_the_report_says_which_rung_was_reached_and_what_was_not_started(climbed):
    _, experiment = climbed
    table = views_of(experiment, store_of(experiment).load()).tables[0].frame
    verdicts = table.set_index(["backend", "rung"])["verdict"]
    assert verdicts["forgetful_climber"].tolist() == ["passed", "failed", "not started", "not started"]
    assert verdicts["numpy"].to_dict() == dict.fromkeys(SCENES, "passed")
    assert ((table["reason"] != "") == (table["verdict"] == "failed")).all()


@pytest.mark.slow
def test_a_second_run_starts_no_rung_above_the_fault(climbed, capsys):
    words, experiment = climbed
    before = store_of(experiment).load()
    assert main(words) == 0
    assert "rung pendulum did not pass" in capsys.readouterr().err
    after = store_of(experiment).load()
    measured = before[before["status"] == "ok"].set_index("key")["stored_at"]
    pd.testing.assert_series_equal(after[after["status"] == "ok"].set_index("key")["stored_at"], measured)
    waiting = after[after["status"] == "waiting"]
    assert len(waiting) == 2
    assert waiting["reason"].str.startswith("the rung below (pendulum) did not pass: ").all()


@pytest.mark.slow
def test_a_rung_that_its_backend_cannot_run_stops_the_climb(tmp_path):
    words = [*WORDS, "scenes=[pendulum,quadruped,double_integrator]", "backends=[numpy]", f"results_dir={tmp_path}"]
    assert main(words) == 0
    experiment = config.load(words)
    assert statuses(experiment, "numpy") == {
        "pendulum": "ok",
        "quadruped": "unsupported",
        "double_integrator": "waiting",
    }
    table = views_of(experiment, store_of(experiment).load()).tables[0].frame
    assert table["verdict"].tolist() == ["passed", "failed", "not started"]
    assert "no cell could be checked" in table["reason"].iloc[1]


@pytest.mark.slow
def test_a_mended_rung_resumes_the_climb_from_there(tmp_path):
    tree = Tree(tmp_path)
    (tree.root / "own").mkdir()
    words = [*WORDS, "backends=[mended]", "plugins=own", "results_dir=out"]
    tree.add("own/mended.py", backend("mended", "pendulum"))
    tree.run(*words)
    climb = tree.root / "out" / "climb"
    assert list(pd.read_csv(climb / "ladder.csv")["verdict"]) == ["passed", "failed", "not started", "not started"]
    # the code of the backend has changed, so that its lower rung is measured again too
    tree.add("own/mended.py", backend("mended", "none"))
    done = tree.run(*words)
    assert list(pd.read_csv(climb / "ladder.csv")["verdict"]) == ["passed"] * 4, done.stderr
    rows = pd.read_parquet(climb / "rows.parquet")
    assert set(rows.loc[rows["parameters"].str.contains('"none"'), "status"]) == {"ok"}
