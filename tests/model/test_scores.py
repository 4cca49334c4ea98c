"""Where theta sets the initial state and noise is on the actions, cost times score is not the gradient: it is refused."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Numpy, SemiImplicitEuler

import bench
from bench.conformance.kit import Skipped
from bench.conformance.scenes import score_gives_the_gradient
from bench.conformance.subjects import available
from bench.measure.reference import certify
from bench.model import MechanicalScene, State, compose, param

GUSTS = '''
"""A mass slides from theta = v_0 and is pushed by gusts: f = (q_T - 1)^2, so that grad J = 2 T (T v_0 - 1)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.plugin import MechanicalScene, State, param


@dataclass(frozen=True)
class Gusts(MechanicalScene):
    """A mass that gusts push."""

    name = "gusts"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1
    noise: str = param("action", "what the noise perturbs", choices=("action",))
    sigma: float = param(0.3, "of each gust", positive=True)
    horizon: int = param(20, "steps", positive=True)
    dt: float = param(0.05, "step", "s", positive=True)

    def theta0(self):
        return np.array([1.7])

    def initial_state(self, xp, theta):
        return State(0.0 * theta[0:1], theta[0:1])

    def acceleration(self, xp, q, v, u):
        return u

    def terminal_cost(self, xp, q, v):
        return (q[0] - 1.0) ** 2
'''
TRUTH = 1.4
"""grad J of ``Gusts``: T = 1 s and v_0 = 1.7 m/s."""
ROUNDED = 1e-6
"""Error of the numpy backend's central differences."""
REASON = "theta sets the initial state of scene {} while noise is on the actions, so that cost times score is not the gradient: use noise=parameter"


@dataclass(frozen=True)
class StartAndPush(MechanicalScene):
    """Open loop, and the first push sets the start as well: the noise is not noise on theta."""

    name = "start_and_push"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1
    open_loop: ClassVar[bool] = True
    noise: str = param("action", "what the noise perturbs", choices=("action",))
    horizon: int = param(20, "steps", positive=True)

    def theta0(self):
        return np.linspace(0.5, 1.0, self.horizon)

    def initial_state(self, xp, theta):
        return State(theta[0:1], 0.0 * theta[0:1])

    def acceleration(self, xp, q, v, u):
        return u

    def terminal_cost(self, xp, q, v):
        return (q[0] - 1.0) ** 2


def test_estimators_that_need_scores_are_refused_in_one_sentence(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "gusts.py").write_text(GUSTS)
    rows = bench.run(
        name="mine",
        plugins=str(tmp_path / "mine"),
        results_dir=str(tmp_path / "out"),
        scenes=["gusts"],
        integrators=["semi_implicit_euler"],
        backends=["numpy"],
        estimators=["fobg", "reinforce", "alpha_order"],
        samples=8,
        repeats=16,
        workers=0,
        timing=False,
        formats=[],
    ).set_index("estimator")
    assert dict(rows["status"]) == {"fobg": "ok", "reinforce": "unsupported", "alpha_order": "unsupported"}
    for name in ("reinforce", "alpha_order"):
        assert rows.loc[name, "reason"] == f"{name} needs scores, but {REASON.format('gusts')}"
    assert "first_order" in rows.loc["fobg", "reference_method"]
    error = 4 * rows.loc["fobg", "reference_se"] + ROUNDED
    assert rows.loc["fobg", "reference_norm"] == pytest.approx(TRUTH, abs=error)


def test_scores_of_an_open_loop_that_sets_its_start_are_refused():
    program = compose(StartAndPush(), None, SemiImplicitEuler())
    problem = Numpy().compile(program)
    assert not program.noise_on_theta
    with pytest.raises(bench.Unsupported, match=f"^{REASON.format('start_and_push')}$"):
        problem.score(program.theta0, np.zeros((program.n_noise, 1)))
    with pytest.raises(Skipped, match="cost times score is not the gradient"):
        score_gives_the_gradient(program.scene)


def test_no_reference_without_scores_and_gradients():
    program = compose(StartAndPush(), None, SemiImplicitEuler())
    reference = certify(Numpy().compile(program), frozenset({"value", "score"}), 1 << 10, 0.05)
    assert reference.note == f"no reference: {REASON.format('start_and_push')}"


def test_scores_of_the_scenes_here_give_the_gradient():
    for scene in available("scenes"):
        if issubclass(scene, MechanicalScene):
            assert not compose(scene(), None, SemiImplicitEuler()).score_refusal
