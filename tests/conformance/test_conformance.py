"""The conformance kit catches the faults planted here, and its checks are pytest items."""

import os
import re
from dataclasses import dataclass
from functools import cache, partial
from typing import ClassVar

import numpy as np
import pytest
from bench.plugins.backends.numpy import Numpy, NumpyProblem
from classes import (
    Cem,
    Cubic,
    DoubleIntegrator,
    ExplicitEuler,
    GradientDescent,
    Heaviside,
    MassSpring,
    Midpoint,
    Penalty,
    Plain,
    Pushing,
    Quadratic,
    QuadraticModel,
    SemiImplicitEuler,
)
from trees import INHERITED, bench

from bench import conformance
from bench.conformance import main, parametrize, subjects
from bench.conformance.kit import variants
from bench.conformance.subjects import all_programs, distinguishing_programs, sound_scenes
from bench.errors import UserError
from bench.model import (
    Backend,
    ContactScene,
    EngineScene,
    Estimator,
    ForceLaw,
    FunctionScene,
    ImpulseLaw,
    MechanicalScene,
    Plugin,
    SampleMean,
    Scene,
    columns,
    compose,
    param,
    per_repeat,
    registry,
)

PLANTED: dict[type[Plugin], set[str]] = {}
"""By plugin with a fault: the checks that have to fail."""


def planted(*checks):
    """Return a decorator of a plugin that the checks have to refuse; it is named after its class."""

    def register(plugin):
        plugin.name = re.sub("(?<!^)(?=[A-Z])", "_", plugin.__name__).lower()
        PLANTED[dataclass(frozen=True)(plugin)] = set(checks)
        return plugin

    return register


# ------------------------------------------------------------------------------------------- planted: estimators


class FirstOrder(SampleMean):
    """The mean of gradients."""

    needs = frozenset({"grad"})

    def terms(self, problem, theta, w):
        return problem.grad(theta, w)


@planted("bias_is_as_declared")
class WrongSign(FirstOrder):
    """First-order, with the wrong sign."""

    def terms(self, problem, theta, w):
        return -super().terms(problem, theta, w)


@planted("bias_is_as_declared")
class WrongInManyDimensions(FirstOrder):
    """First-order, off by 30% where theta has more than five numbers."""

    def terms(self, problem, theta, w):
        return super().terms(problem, theta, w) * (1.3 if theta.size > 5 else 1.0)


@planted("bias_is_as_declared", "bias_across_jumps_is_as_declared")
class SigmaForSigmaSquared(SampleMean):
    """Zeroth-order, f sigma w / sigma^2 with a sigma for the sigma^2."""

    unbiased_at_discontinuities = True

    def terms(self, problem, theta, w):
        cost = problem.value(theta, w) - problem.value(theta, 0 * w[:, :1])
        return cost * problem.sigma * w / problem.sigma


@planted("uses_every_sample")
class SecondHalfIsTheFirst(FirstOrder):
    """First-order, using the first half of the noise twice."""

    def estimate(self, problem, theta, noise):
        half = noise[:, : noise.shape[1] // 2]
        return super().estimate(problem, theta, np.concatenate([half, half], axis=1))


@planted("repeats_are_independent")
class RepeatsAreTheFirst(FirstOrder):
    """First-order, with the noise of repeat 0 in every repeat."""

    def estimate(self, problem, theta, noise):
        return super().estimate(problem, theta, np.broadcast_to(noise[:1], noise.shape))


@planted("variance_falls_as_one_over_n")
class SixteenSamples(FirstOrder):
    """First-order, from the first 16 samples whatever their number."""

    def estimate(self, problem, theta, noise):
        return super().estimate(problem, theta, noise[:, :16])


@planted("variance_falls_as_one_over_n")
class UndeclaredCoupling(QuadraticModel):
    """Zeroth-order less a model fitted to the samples, which it does not declare."""

    couples_samples: ClassVar[bool] = False


@planted("bias_is_as_declared")
class OwnSampleInBaseline(Estimator):
    """Zeroth-order, with a batch mean as baseline that counts the sample itself."""

    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True

    def estimate(self, problem, theta, noise):
        w = columns(noise)
        f, score = per_repeat(problem.value(theta, w), noise), per_repeat(problem.score(theta, w), noise)
        return ((f - f.mean(axis=1, keepdims=True))[..., None] * score).mean(axis=1)


@planted("bias_under_every_design")
class OtherSamplesOfTheUnitInBaseline(Estimator):
    """Zeroth-order, with the mean of the other samples as baseline, mirror images included."""

    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True

    def estimate(self, problem, theta, noise):
        w = columns(noise)
        f, score = (per_repeat(of(theta, w), noise) for of in (problem.value, problem.score))
        others = (f.sum(axis=1, keepdims=True) - f) / (f.shape[1] - 1)
        return ((f - others)[..., None] * score).mean(axis=1)


@planted("bias_under_action_feedback")
class OpenLoopScore(SampleMean):
    """Zeroth-order, with the score of an open-loop control under feedback too."""

    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True

    def terms(self, problem, theta, w):
        cost = problem.value(theta, w) - problem.value(theta, 0 * w[:, :1])
        return cost * (0 * problem.score(theta, w) + w[: problem.dim] / problem.sigma)


@planted("shape_and_repeatability")
class OwnNoise(FirstOrder):
    """First-order, at noise of its own."""

    def terms(self, problem, theta, w):
        return super().terms(problem, theta, np.random.default_rng().standard_normal(w.shape))


@planted("needs_are_truthful")
class UndeclaredValue(FirstOrder):
    """First-order, and it looks at costs without saying so."""

    def terms(self, problem, theta, w):
        return super().terms(problem, theta, w) + 0 * problem.value(theta, w)


@planted("needs_are_truthful")
class UnusedScore(FirstOrder):
    """First-order, and it asks for scores it never uses."""

    needs = frozenset({"grad", "score"})


@planted("bias_across_jumps_is_as_declared")
class ClaimsJumps(FirstOrder):
    """First-order, and it claims to be right across jumps."""

    unbiased_at_discontinuities = True


@planted("bias_across_jumps_is_as_declared")
class DeniesJumps(SampleMean):
    """Zeroth-order, and it denies being right across jumps."""

    needs = frozenset({"value", "score"})

    def terms(self, problem, theta, w):
        return problem.value(theta, w) * problem.score(theta, w)


@planted("bias_is_as_declared")
class LastingBias(FirstOrder):
    """First-order, two and a half times as large however many samples there are."""

    unbiased = False

    def terms(self, problem, theta, w):
        return 2.5 * super().terms(problem, theta, w)


@planted("noise_is_drawn_as_declared")
class ClaimsNoNoise(FirstOrder):
    """First-order, and it claims to draw no noise."""

    def draws_noise(self, program):
        return False


@planted("noise_is_drawn_as_declared")
class DrawsNoNoise(FirstOrder):
    """First-order without noise, which it does not declare."""

    unbiased = False

    def terms(self, problem, theta, w):
        return super().terms(problem, theta, 0 * w)


@planted("bias_is_as_declared")
class PlainWithWrongSign(Plain):
    """The gradient without noise, with the wrong sign."""

    def estimate(self, problem, theta, noise):
        return -super().estimate(problem, theta, noise)


@planted("something_was_checked")
class RefusesEverything(FirstOrder):
    """First-order, for programs that do not exist."""

    def own_refusal(self, program):
        return "not this one"


# --------------------------------------------------------------------------------------------- planted: backends


@dataclass(frozen=True)
class Faulty(Numpy):
    """The NumPy backend with a faulty problem."""

    faulty: ClassVar[type[NumpyProblem]]

    def compile(self, program):
        return self.faulty(program, self.dtype, 1e-6 if self.dtype == "float64" else 5e-3)


@planted("gradient_is_that_of_value")
class ClaimsSurrogates(Faulty):
    """Declares surrogate gradients and returns derivatives by differences."""

    provides = Numpy.provides | {"surrogate"}
    faulty = NumpyProblem


class SofterProblem(NumpyProblem):
    def _grad(self, theta, w):
        program = self.program
        if isinstance(program.contact, Penalty):
            law = Penalty(stiffness=program.contact.stiffness / 2, damping=program.contact.damping)
            program = compose(program.scene, law, program.integrator)
        return NumpyProblem(program, self._dtype.name, self._step)._grad(theta, w)


@planted("gradient_is_that_of_value")
class HalfStiffnessGradient(Faulty):
    """Gradients of a contact half as stiff."""

    faulty = SofterProblem


class HomeProblem(NumpyProblem):
    def _grad(self, theta, w):
        home = self.program.theta0[:, None]
        near = np.clip(theta, home - self.sigma, home + self.sigma)
        return super()._grad(near, w)


@planted("gradient_is_that_of_value")
class GradientOfItsOwnTheta(Faulty):
    """Gradients that are right only near the scene's own theta."""

    faulty = HomeProblem


class ForgetfulProblem(NumpyProblem):
    def _score(self, theta, w):
        return np.broadcast_to(w.sum(axis=0) / self.sigma, (self.dim, w.shape[1]))


@planted("score_is_that_of_actions")
class WrongScore(Faulty):
    """Scores that leave out the states a policy acted on."""

    faulty = ForgetfulProblem


class LeakyProblem(NumpyProblem):
    def _value(self, theta, w):
        cost = super()._value(theta, w)
        return cost + 1e-3 * cost.mean()


@planted("columns_are_independent", "value_agrees")
class LeakyColumns(Faulty):
    """Costs that mix a little of the batch into every column."""

    faulty = LeakyProblem


@planted("root_is_differentiated_implicitly")
class ClaimsRoot(Numpy):
    """Claims to solve equations."""

    provides = Backend.provides | {"root"}


@planted("single_precision_is_finite")
class DoubleAnyway(Numpy):
    """Float64 whatever the dtype."""

    def compile(self, program):
        return NumpyProblem(program, "float64", 1e-6)


# ------------------------------------------------------------------------------------------- planted: optimizers


@planted("path_repeats_after_a_stop")
class Forgetful(GradientDescent):
    """It keeps the iteration outside its state."""

    def step(self, state, gradient):
        counts = self.__dict__.setdefault("counts", [0])
        counts[0] += 1
        return {"theta": state["theta"] - 0.1 / counts[0] * gradient, "iteration": 0}


@planted("state_is_left_alone")
class Careless(GradientDescent):
    """It changes the state it was given."""

    def step(self, state, gradient):
        state["theta"] -= 0.1 * gradient
        return {"theta": state["theta"].copy(), "iteration": state["iteration"]}


@planted("needs_are_declared")
class Greedy(Cem):
    """It declares a need that it never has."""

    needs = frozenset({"value", "gradient"})

    def required_fields(self, state):
        return frozenset({"value"})


@planted("descends_on_a_bowl")
class Climbing(GradientDescent):
    """The wrong sign."""

    def step(self, state, gradient):
        return {"theta": state["theta"] + 0.1 * gradient, "iteration": 0}


# ----------------------------------------------------------------------------------------------- planted: scenes


@planted("closed_form_is_right")
class WrongClosedForm(Quadratic):
    """A bowl whose stated gradient is 5% too long."""

    def closed_form_gradient(self, contact, integrator):
        return 1.05 * super().closed_form_gradient(contact, integrator)


@planted("continuity_is_as_declared")
class ClaimsContinuity(Heaviside):
    """A step that claims to be continuous."""

    continuous = True


@planted("continuity_is_as_declared")
class ClaimsAJump(Cubic):
    """A cubic that claims to jump."""

    continuous = False


@planted("continuity_is_as_declared")
class JumpsElsewhere(Cubic):
    """A cubic with a step 7 sigma from theta, that claims to be continuous."""

    def cost(self, xp, x):
        return super().cost(xp, x) + xp.where(x[0] > self.theta0()[0] + 7.0 * self.sigma, 1.0, 0.0)


@planted("physical_gradient_is_the_limit")
class WrongPhysics(MassSpring):
    """A physical gradient that is finite, of the right shape, and half as long again in one coordinate."""

    def physical_gradient(self):
        gradient = super().physical_gradient()
        return None if gradient is None else gradient * [1.0, 1.5]


@planted("closed_form_is_right")
class ClaimsControls(DoubleIntegrator):
    """A theta that is twice the controls, with the gradient of one that is the controls."""

    def planned_controls(self, xp, theta):
        return 2.0 * super().planned_controls(xp, theta)


@planted("costs_are_finite")
class MixedColumns(FunctionScene):
    """A cost that depends on the whole batch."""

    def theta0(self):
        return np.ones(2)

    def cost(self, xp, x):
        return xp.sum(x * x, axis=0) - xp.mean(x)


@planted("backends_agree")
class NumpyOnly(MixedColumns):
    """A cost that only NumPy can evaluate."""

    def cost(self, xp, x):
        return np.square(np.array(x)).sum(axis=0)


@planted("contact_geometry_is_consistent")
class PullsTogether(Pushing):
    """Bodies that a contact force pulls together."""

    def contact_acceleration(self, xp, q, force):
        return -super().contact_acceleration(xp, q, force)


@planted("contact_geometry_is_consistent")
class WrongGapRate(Pushing):
    """A gap rate that forgets one of the bodies."""

    def gap_rate(self, xp, q, v):
        return v[1:2]


@planted("contact_geometry_is_consistent")
class NoContacts(Pushing):
    """Bodies that touch, and no number of contacts."""

    n_contacts = 0


@planted("state_has_declared_size")
class WrongStateSize(DoubleIntegrator):
    """Two coordinates declared, and one given."""

    n_q = 2


# -------------------------------------------------------------------------------- planted: contacts and integrators


@planted("pushes_in_contact", "force_grows_with_penetration")
class Attracts(ForceLaw):
    """A spring that pulls bodies into each other."""

    def force(self, xp, gap, gap_rate):
        return xp.where(gap < 0, 1e3 * gap, 0.0 * gap)


@planted("does_not_push_from_afar")
class SmoothsNothing(Penalty):
    """A penalty pushing from afar, with a smoothing parameter that changes nothing."""

    smoothing: ClassVar[str] = "beta"

    beta: float = param(100.0, "unused", positive=True)

    def force(self, xp, gap, gap_rate):
        return super().force(xp, gap, gap_rate) + 0.1


@planted("continuity_in_rollouts_is_as_declared")
class SecretJump(Penalty):
    """A damper that sets in at once, and a claim to be continuous."""

    continuous = True  # type: ignore[assignment]

    damping: float = param(1.0, "force per penetration rate", "N s/m", low=0.0)


@planted("impulse_keeps_momentum")
class OneSided(ImpulseLaw):
    """Pushes only the first body."""

    continuous = False

    def impulse(self, ops, contact, before, free, dt):
        rate = contact.gap_rate(before.q, before.v)
        hit = (contact.gap(before.q + dt * before.v) < 0) & (rate < 0)
        change = contact.acceleration(before.q, ops.xp.where(hit, -rate, 0.0 * rate))
        change = ops.xp.concat([change[:1], 0.0 * change[1:]], axis=0)
        return type(free)(0.0 * change, change)


@planted("error_falls_with_declared_order")
class WrongOrder(SemiImplicitEuler):
    """A first-order integrator that claims second order."""

    order = 2


@planted("takes_impulses_is_truthful")
class DropsImpulses(ExplicitEuler):
    """Claims to take impulses, and drops them."""

    takes_impulses = True


@planted("amplification_is_that_of_the_step")
class WrongStabilityFunction(Midpoint):
    """A second-order step that states the factor of a first-order one."""

    def amplification(self, z):
        return 1 + z


@planted("transition_is_that_of_the_step")
class ForgetsTheFactor(SemiImplicitEuler):
    """States a matrix without the velocity factor."""

    def transition(self, dt, stiffness, damping, factor):
        return super().transition(dt, stiffness, damping, 1.0)


# ---------------------------------------------------------------------------------------------- planted: any plugin


class NotADataclass(Cubic):
    """A plugin without its own decorator."""

    name = "not_a_dataclass"


@planted("has_docstring")
class Undocumented(Cubic):
    pass


@dataclass(frozen=True)
class BadName(Cubic):
    """A name that a command line would trip over."""

    name = "Bad name"


@planted("declares_parameters")
class BareField(Cubic):
    """A parameter without a meaning."""

    width: float = 1.0


@planted("builds")
class Unfinished(Scene):
    """A scene without a single method."""


@planted("something_was_checked")
class NothingApplies(Plugin):
    """A scene by its kind, of a class that no check of scenes knows."""

    kind: ClassVar[str] = "scenes"


@planted("declares_parameters")
class RefusedDefault(Cubic):
    """A default outside its own bounds."""

    width: float = param(-1.0, "width", positive=True)


def local():
    @planted("survives_spawned_process")
    class Unpicklable(Cubic):
        """A class that no other process can find."""


local()
PLANTED |= {NotADataclass: {"is_frozen_dataclass"}, BadName: {"has_good_name"}}


@pytest.fixture
def few_programs(monkeypatch):
    """Checks of backends and contact laws run one program of each sort and one with a surrogate, and every fourth scene with contacts."""
    programs = distinguishing_programs(all_programs())
    programs.append(next(program for program in all_programs() if program.surrogate and not program.needs_root))
    touching = [scene for scene in sound_scenes() if isinstance(scene, ContactScene) and scene.continuous]
    monkeypatch.setattr(conformance.backends, "all_programs", lambda: programs)
    monkeypatch.setattr(conformance.contacts, "sound_scenes", lambda: touching[::4])
    monkeypatch.setattr(conformance.subjects, "PARTS", 64)
    # each function at one of the two sizes of the noise, in turn
    oracles = [*conformance.estimators.oracles()[::4], *conformance.estimators.oracles()[3::4]]
    monkeypatch.setattr(conformance.estimators, "oracles", lambda: oracles)


def items(*arguments, **options):
    """The (plugin, check) pairs that the decorator makes, by id, with their marks."""
    return {item.id: item for item in parametrize(*arguments, **options).args[1]}


def found(plugin, *checks):
    """The outcome of each of the named checks, or of all, with what it says: its number or its reason."""
    outcomes = []
    for title, item in items([plugin]).items():
        subject, run = item.values
        if not checks or title.rpartition("-")[2] in checks:
            try:
                outcomes.append(("pass", run(subject)))
            except pytest.skip.Exception as reason:
                outcomes.append(("skip", str(reason)))
            except (pytest.fail.Exception, SystemExit, Exception) as reason:
                outcomes.append(("fail", str(reason)))
    return outcomes


@pytest.mark.usefixtures("few_programs")
@pytest.mark.parametrize("plugin", PLANTED, ids=lambda plugin: plugin.name)
def test_planted_fault_is_caught(plugin):
    for check in PLANTED[plugin]:
        assert "fail" in dict(found(plugin, check)), check


@dataclass(frozen=True)
class Mirrored(FirstOrder):
    """First-order, the mean of the gradients at w and -w."""

    name = "mirrored"

    def terms(self, problem, theta, w):
        return (super().terms(problem, theta, w) + super().terms(problem, theta, -w)) / 2


@pytest.mark.usefixtures("few_programs")
def test_a_sound_estimator_passes_though_a_difference_straddles_a_jump():
    (bias, one), (across, other) = found(Mirrored, "bias_is_as_declared", "bias_across_jumps_is_as_declared")
    assert bias == across == "pass"
    assert "of up to 20 dimensions" in one
    assert "bias 21.4 on coin_walk[sigma=0.1]" in other


@pytest.mark.parametrize(("module", "where"), [(__name__, " in test_conformance.py"), ("notebook", "")])
def test_a_wrong_shape_is_named_with_the_file_and_the_shape_of_terms(module, where):
    class Row(Mirrored):
        __module__ = module

        def terms(self, problem, theta, w):
            return problem.grad(theta, w)[:1].T

    ((_, reason),) = found(Row, "shape_and_repeatability")
    assert f"mirrored{where} returned shape (56, 1), not (d, B) = (2, 56)" in reason


# ------------------------------------------------------------------------------------------------ abstract plugins


@pytest.mark.parametrize("base", [MechanicalScene, DoubleIntegrator])
def test_contacts_without_contact_scene_are_refused_with_the_fix(base):
    with pytest.raises(TypeError, match=r"Touching has n_contacts=1: derive it from ContactScene and define gap"):
        type("Touching", (base,), {"n_contacts": 1})
    for role in (ContactScene, EngineScene):
        assert type("Touching", (role,), {"n_contacts": 1}).n_contacts == 1


# ---------------------------------------------------------------------------------------------- as pytest items


def test_every_check_of_every_variant_is_an_item():
    made = items([Penalty])
    assert {item.split("-")[0] for item in made} == set(variants(Penalty))
    assert {"penalty-has_docstring", "penalty-pushes_in_contact", "penalty-something_was_checked"} <= set(made)
    assert set(found(Penalty, "smoothing_converges")) == {("skip", "has no smoothing")}


def test_expected_failures_are_strict_and_say_why():
    made = items([Cubic, Quadratic], expected_failures={"cubic-backends_agree": "see #12", "has_docstring": "late"})
    marks = {title: [(m.name, m.kwargs) for m in item.marks] for title, item in made.items() if item.marks}
    late = [("xfail", {"reason": "late", "strict": True})]
    assert marks == {
        "cubic-backends_agree": [("xfail", {"reason": "see #12", "strict": True})],
        "cubic-has_docstring": late,
        "quadratic-has_docstring": late,
    }


def test_expected_failure_of_no_check_gets_the_nearest_name():
    with pytest.raises(UserError, match="did you mean 'has_docstring'"):
        parametrize([Cubic], expected_failures={"has_docstrings": "none"})


def test_plugin_that_lacks_a_module_is_skipped():
    absent = dataclass(frozen=True)(type("Absent", (Cubic,), {"name": "absent", "requires": ("no_such_module",)}))
    reasons = {item.marks[0].kwargs["reason"] for item in items([absent]).values() if item.marks[0].name == "skip"}
    assert reasons == {"not installed: no_such_module; pip install no_such_module"}


def test_plugin_of_another_kind_needs_no_checks_of_its_own():
    study = next(iter(registry.entries()["studies"].values())).plugin
    assert {outcome for outcome, _ in found(study)} == {"pass"}


# ------------------------------------------------------------------------------- the command, broken neighbours

SCENE = """
import os, sys, time
from dataclasses import dataclass
import numpy as np
from bench.plugin import FunctionScene

@dataclass(frozen=True)
class Mine(FunctionScene):
    \"\"\"A cost.\"\"\"
    name = "NAME"
    def theta0(self):
        BODY
        return np.ones(2)
    def cost(self, xp, x):
        return x[0] * x[1]
"""
BODIES = {
    "ends": ("os._exit(0)", "worker 'gw0' crashed while running"),
    "exits": ("sys.exit(0)", "SystemExit"),
    "hangs": ("time.sleep(1000)", "worker 'gw1' crashed while running"),
    "prints": ("print('x' * 9)", "d = 2, parameter noise"),
    "raises": ("1 / 0", "ZeroDivisionError"),
}
"""What a scene does where it is asked for theta, and what the line of the check has to say."""
BROKEN_BACKEND = """
from dataclasses import dataclass
from bench.plugin import Backend

@dataclass(frozen=True)
class ABroken(Backend):
    \"\"\"Raises whatever is asked.\"\"\"
    name = "a_broken"
    provides = frozenset({"value", "grad", "score"}) | PROVIDES
    def compile(self, program):
        raise ZeroDivisionError("compile")
    def own_refusal(self, program):
        raise ZeroDivisionError("reason")
"""


@pytest.fixture
def check(tmp_path, monkeypatch):
    """Return what runs the command in a read-only folder of plugins with foreign settings of pytest."""
    for name, (body, _) in BODIES.items():
        (tmp_path / f"{name}.py").write_text(SCENE.replace("NAME", name).replace("BODY", body))
    (tmp_path / "lacks.py").write_text(SCENE.replace("NAME", "lacks").replace("def cost", "def price"))
    (tmp_path / "conftest.py").write_text("raise RuntimeError('read')")
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --unknown")
    (tmp_path / "out").mkdir()
    files = set(tmp_path.iterdir())
    tmp_path.chmod(0o500)
    for name in ("PYTEST_ADDOPTS", "PYTEST_PLUGINS"):
        monkeypatch.setitem(INHERITED, name, "--unknown")
    yield partial(bench, "check", "plugins=.", folder=tmp_path)
    assert set(tmp_path.iterdir()) == files
    tmp_path.chmod(0o700)


@pytest.mark.slow
def test_the_command_survives_any_plugin(check, tmp_path):
    few = ["-k", "has_docstring or theta_and_noise or available", "--junitxml=out/report.xml"]
    done = check(*BODIES, "lacks", "limit=30s", *few)
    assert done.returncode == 1, done.stdout + done.stderr
    lines = (line.split(maxsplit=3) for line in done.stdout.splitlines() if re.match("[a-z]{4}  ", line))
    said = {(plugin, name): (outcome, detail) for outcome, plugin, name, detail in lines}
    assert said["lacks", "available"] == ("fail", "Mine does not define cost")
    for plugin, (_, expected) in BODIES.items():
        assert said[plugin, "has_docstring"] == ("pass", "A cost.")
        outcome, detail = said[plugin, "theta_and_noise_are_declared"]
        assert outcome == ("pass" if plugin == "prints" else "fail")
        assert expected in detail
    assert "Timeout (0:00:30)!" in done.stderr
    report = (tmp_path / "out" / "report.xml").read_text()
    assert 'tests="11"' in report
    assert '<property name="found" value="d = 2, parameter noise"' in report


@pytest.mark.slow
def test_a_missing_plugin_is_skipped_unless_named_and_no_check_is_bad_input(check):
    done = check("-k", "lacks")
    assert (done.returncode, done.stdout.count("skip  lacks")) == (0, 1)
    for words in (["-k", "nothing_matches"], ["--no-such-option"], ["no_such_file"]):
        assert check("prints", "-x", *words).returncode == 2


def test_statuses_are_those_of_a_command(monkeypatch):
    monkeypatch.setattr(os, "environ", {})
    statuses = iter(pytest.ExitCode)
    monkeypatch.setattr(pytest, "main", lambda *_, **__: next(statuses))
    assert [main(["linear"]), main(["linear"])] == [0, 1]
    with pytest.raises(KeyboardInterrupt):
        main(["linear"])
    assert [main(["linear"]) for _ in range(3)] == [2, 2, 2]


def test_without_pytest_the_command_that_installs_it_is_named(monkeypatch):
    monkeypatch.setattr(registry, "installed", lambda name: name != "xdist")
    with pytest.raises(UserError, match=r"pip install 'diffsim-bench\[check\]'"):
        main(["linear"])


def test_a_limit_that_is_no_duration_is_refused():
    with pytest.raises(UserError, match="limit=soon is not a duration"):
        main(["linear"], "soon")


@pytest.mark.slow
@pytest.mark.parametrize("provides", ["{'physics'}", "set()"])
def test_a_broken_backend_does_not_fail_the_checks_of_a_scene(tmp_path, monkeypatch, provides):
    (tmp_path / "a_broken.py").write_text(BROKEN_BACKEND.replace("PROVIDES", provides))
    registry.add_folder(tmp_path)
    for cached in ("plain_backend", "all_programs", "sound_laws"):
        monkeypatch.setattr(subjects, cached, cache(getattr(subjects, cached).__wrapped__))
    for name in ("linear", "double_integrator", "tossed_box"):
        assert "fail" not in dict(found(registry.usable("scenes", name)))
    assert ("fail", "reason") in found(registry.usable("backends", "a_broken"))
