"""Every registered plugin passes the conformance kit, and the kit catches the faults planted here."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from bench import registry
from bench.conformance import check, main
from bench.contracts import (
    Array,
    Backend,
    Estimator,
    ForceLaw,
    FunctionScene,
    ImpulseLaw,
    Problem,
    Program,
    SampleMean,
    columns,
    param,
    per_repeat,
)
from plugins.backends.numpy import Numpy, NumpyProblem
from plugins.contacts.penalty import Penalty
from plugins.contacts.softplus import Softplus
from plugins.integrators.explicit_euler import ExplicitEuler
from plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from plugins.scenes.cubic import Cubic
from plugins.scenes.double_integrator import DoubleIntegrator
from plugins.scenes.heaviside import Heaviside
from plugins.scenes.pushing import Pushing
from plugins.scenes.quadratic import Quadratic


def _is_long(entry: registry.Entry) -> bool:
    """Whether its kit takes a minute, or many: engines and solvers, each of whose programs compiles for seconds."""
    return entry.plugin is not None and bool({"physics", "root"} & set(getattr(entry.plugin, "provides", ())))


ENTRIES = [
    pytest.param(entry, id=f"{entry.kind}-{entry.name}", marks=[pytest.mark.slow] if _is_long(entry) else [])
    for table in registry.entries().values()
    for entry in table.values()
]


@pytest.mark.parametrize("entry", ENTRIES)
def test_registered_plugin_conforms(entry):
    if not entry.available:
        pytest.skip(entry.reason)
    results = check(entry.plugin)
    assert {result.outcome for result in results} <= {"pass", "skip"}, [r for r in results if r.outcome == "fail"]
    assert sum(result.outcome == "pass" for result in results) > 5


# ------------------------------------------------------------------------------------------- planted: estimators


@dataclass(frozen=True)
class WrongSign(SampleMean):
    """First-order, with the wrong sign."""

    name = "wrong_sign"
    needs = frozenset({"grad"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return -problem.grad(theta, w)


@dataclass(frozen=True)
class SigmaForSigmaSquared(SampleMean):
    """Zeroth-order, f sigma w / sigma^2 with a sigma for the sigma^2."""

    name = "sigma_for_sigma_squared"
    across_jumps = True

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        cost = problem.value(theta, w) - problem.value(theta, 0 * w[:, :1])
        return cost * problem.sigma * w / problem.sigma


@dataclass(frozen=True)
class SecondHalfIsTheFirst(SampleMean):
    """First-order, using the first half of the noise twice."""

    name = "second_half_is_the_first"
    needs = frozenset({"grad"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return problem.grad(theta, w)

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        half = noise[:, : noise.shape[1] // 2]
        return super().estimate(problem, theta, np.concatenate([half, half], axis=1))


@dataclass(frozen=True)
class RepeatsAreTheFirst(SecondHalfIsTheFirst):
    """First-order, with the noise of repeat 0 in every repeat."""

    name = "repeats_are_the_first"

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return SampleMean.estimate(self, problem, theta, np.broadcast_to(noise[:1], noise.shape))


@dataclass(frozen=True)
class SixteenSamples(SecondHalfIsTheFirst):
    """First-order, from the first 16 samples whatever their number."""

    name = "sixteen_samples"

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return SampleMean.estimate(self, problem, theta, noise[:, :16])


@dataclass(frozen=True)
class OwnSampleInBaseline(Estimator):
    """Zeroth-order, with a batch mean as baseline that counts the sample itself."""

    name = "own_sample_in_baseline"
    needs = frozenset({"value", "score"})
    across_jumps = True

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        w = columns(noise)
        f, score = per_repeat(problem.value(theta, w), noise), per_repeat(problem.score(theta, w), noise)
        return ((f - f.mean(axis=1, keepdims=True))[..., None] * score).mean(axis=1)


@dataclass(frozen=True)
class OpenLoopScore(SampleMean):
    """Zeroth-order, with the score of an open-loop control under feedback too."""

    name = "open_loop_score"
    needs = frozenset({"value", "score"})
    across_jumps = True

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        cost = problem.value(theta, w) - problem.value(theta, 0 * w[:, :1])
        return cost * (0 * problem.score(theta, w) + w[: problem.dim] / problem.sigma)


@dataclass(frozen=True)
class OwnNoise(SampleMean):
    """First-order, at noise of its own."""

    name = "own_noise"
    needs = frozenset({"grad"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return problem.grad(theta, np.random.default_rng().standard_normal(w.shape))


@dataclass(frozen=True)
class UndeclaredValue(SampleMean):
    """First-order, and it looks at costs without saying so."""

    name = "undeclared_value"
    needs = frozenset({"grad"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return problem.grad(theta, w) + 0 * problem.value(theta, w)


@dataclass(frozen=True)
class UnusedScore(SecondHalfIsTheFirst):
    """First-order, and it asks for scores it never uses."""

    name = "unused_score"
    needs = frozenset({"grad", "score"})

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return SampleMean.estimate(self, problem, theta, noise)


@dataclass(frozen=True)
class ClaimsJumps(UnusedScore):
    """First-order, and it claims to be right across jumps."""

    name = "claims_jumps"
    needs = frozenset({"grad"})
    across_jumps = True


@dataclass(frozen=True)
class DeniesJumps(SampleMean):
    """Zeroth-order, and it denies being right across jumps."""

    name = "denies_jumps"
    needs = frozenset({"value", "score"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return problem.value(theta, w) * problem.score(theta, w)


@dataclass(frozen=True)
class LastingBias(UnusedScore):
    """First-order, two and a half times as large however many samples there are."""

    name = "lasting_bias"
    needs = frozenset({"grad"})
    unbiased = False

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return 2.5 * problem.grad(theta, w)


@dataclass(frozen=True)
class RefusesEverything(UnusedScore):
    """First-order, for programs that do not exist."""

    name = "refuses_everything"

    def refuses(self, program: Program) -> str | None:
        return "not this one"


# --------------------------------------------------------------------------------------------- planted: backends


@dataclass(frozen=True)
class Faulty(Numpy):
    """The NumPy backend with a faulty problem."""

    faulty: ClassVar[type[NumpyProblem]]

    def compile(self, program: Program) -> Problem:
        return self.faulty(program, self.dtype, 1e-6 if self.dtype == "float64" else 5e-3)


class OtherLawProblem(NumpyProblem):
    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        program = self.program
        if isinstance(program.contact, Penalty):
            program = Program(program.scene, Softplus(stiffness=program.contact.stiffness), program.integrator)
        return NumpyProblem(program, self._dtype.name, self._step)._grad(theta, w)


@dataclass(frozen=True)
class GradientOfAnotherLaw(Faulty):
    """Costs of the penalty law, gradients of the softplus law."""

    name = "gradient_of_another_law"
    faulty = OtherLawProblem


class SofterProblem(NumpyProblem):
    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        program = self.program
        if isinstance(program.contact, Penalty):
            law = Penalty(stiffness=program.contact.stiffness / 2, damping=program.contact.damping)
            program = Program(program.scene, law, program.integrator)
        return NumpyProblem(program, self._dtype.name, self._step)._grad(theta, w)


@dataclass(frozen=True)
class HalfStiffnessGradient(Faulty):
    """Gradients of a contact half as stiff."""

    name = "half_stiffness_gradient"
    faulty = SofterProblem


class ForgetfulProblem(NumpyProblem):
    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.broadcast_to(w.sum(axis=0) / self.sigma, (self.dim, w.shape[1]))


@dataclass(frozen=True)
class WrongScore(Faulty):
    """Scores that leave out the states a policy acted on."""

    name = "wrong_score"
    faulty = ForgetfulProblem


class LeakyProblem(NumpyProblem):
    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        cost = super()._value(theta, w)
        return cost + 1e-3 * cost.mean()


@dataclass(frozen=True)
class LeakyColumns(Faulty):
    """Costs that mix a little of the batch into every column."""

    name = "leaky_columns"
    faulty = LeakyProblem


@dataclass(frozen=True)
class ClaimsRoot(Numpy):
    """Claims to solve equations."""

    name = "claims_root"
    provides = Backend.provides | {"root"}


@dataclass(frozen=True)
class DoubleAnyway(Numpy):
    """Float64 whatever the dtype."""

    name = "double_anyway"

    def compile(self, program: Program) -> Problem:
        return NumpyProblem(program, "float64", 1e-6)


# ----------------------------------------------------------------------------------------------- planted: scenes


@dataclass(frozen=True)
class WrongClosedForm(Quadratic):
    """A bowl whose stated gradient is 5% too long."""

    name = "wrong_closed_form"

    def closed_form_gradient(self, contact: Any, integrator: Any) -> np.ndarray:
        return 1.05 * super().closed_form_gradient(contact, integrator)


@dataclass(frozen=True)
class ClaimsContinuity(Heaviside):
    """A step that claims to be continuous."""

    name = "claims_continuity"
    continuous = True


@dataclass(frozen=True)
class ClaimsAJump(Cubic):
    """A cubic that claims to jump."""

    name = "claims_a_jump"
    continuous = False


@dataclass(frozen=True)
class ClaimsControls(DoubleIntegrator):
    """A theta that is twice the controls, and a claim to be the controls."""

    name = "claims_controls"

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        return 2.0 * super().planned_controls(xp, theta)


@dataclass(frozen=True)
class MixedColumns(FunctionScene):
    """A cost that depends on the whole batch."""

    name = "mixed_columns"

    def theta0(self) -> np.ndarray:
        return np.ones(2)

    def cost(self, xp: Any, x: Array) -> Array:
        return xp.sum(x * x, axis=0) - xp.mean(x)


@dataclass(frozen=True)
class NumpyOnly(MixedColumns):
    """A cost that only NumPy can evaluate."""

    name = "numpy_only"

    def cost(self, xp: Any, x: Array) -> Array:
        return np.square(np.array(x)).sum(axis=0)


@dataclass(frozen=True)
class PullsTogether(Pushing):
    """Bodies that a contact force pulls together."""

    name = "pulls_together"

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        return -super().contact_acceleration(xp, q, force)


@dataclass(frozen=True)
class WrongGapRate(Pushing):
    """A gap rate that forgets one of the bodies."""

    name = "wrong_gap_rate"

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        return v[1:2]


# -------------------------------------------------------------------------------- planted: contacts and integrators


@dataclass(frozen=True)
class Attracts(ForceLaw):
    """A spring that pulls bodies into each other."""

    name = "attracts"

    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        return xp.where(gap < 0, 1e3 * gap, 0.0 * gap)


@dataclass(frozen=True)
class SmoothsNothing(Penalty):
    """A penalty pushing from afar, with a smoothing parameter that changes nothing."""

    name = "smooths_nothing"
    smoothing: ClassVar[str] = "beta"

    beta: float = param(100.0, "unused", positive=True)

    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        return super().force(xp, gap, gap_rate) + 0.1


@dataclass(frozen=True)
class SecretJump(Penalty):
    """A damper that sets in at once, and a claim to be continuous."""

    name = "secret_jump"
    continuous = True  # type: ignore[assignment]

    damping: float = param(1.0, "force per penetration rate", "N s/m", low=0.0)


@dataclass(frozen=True)
class OneSided(ImpulseLaw):
    """Pushes the first body alone."""

    name = "one_sided"
    continuous = False

    def impulse(self, ops: Any, contact: Any, before: Any, free: Any, dt: Any) -> Any:
        rate = contact.gap_rate(before.q, before.v)
        hit = (contact.gap(before.q + dt * before.v) < 0) & (rate < 0)
        change = contact.acceleration(before.q, ops.xp.where(hit, -rate, 0.0 * rate))
        change = ops.xp.concat([change[:1], 0.0 * change[1:]], axis=0)
        return type(free)(0.0 * change, change)


@dataclass(frozen=True)
class WrongOrder(SemiImplicitEuler):
    """A first-order integrator that claims second order."""

    name = "wrong_order"
    order = 2


@dataclass(frozen=True)
class DropsImpulses(ExplicitEuler):
    """Claims to take impulses, and drops them."""

    name = "drops_impulses"
    takes_impulses = True


# ---------------------------------------------------------------------------------------------- planted: any plugin


class NotADataclass(Cubic):
    """A plugin without its own decorator."""

    name = "not_a_dataclass"


@dataclass(frozen=True)
class Undocumented(Cubic):
    name = "undocumented"


@dataclass(frozen=True)
class BadName(Cubic):
    """A name that a command line would trip over."""

    name = "Bad name"


@dataclass(frozen=True)
class BareField(Cubic):
    """A parameter without a meaning."""

    name = "bare_field"

    width: float = 1.0


@dataclass(frozen=True)
class RefusedDefault(Cubic):
    """A default outside its own bounds."""

    name = "refused_default"

    width: float = param(-1.0, "width", positive=True)


def _local() -> type[Cubic]:
    @dataclass(frozen=True)
    class Unpicklable(Cubic):
        """A class that no other process can find."""

        name = "unpicklable"

    return Unpicklable


PLANTED = {
    WrongSign: {"bias_is_as_declared"},
    SigmaForSigmaSquared: {"bias_is_as_declared", "bias_across_jumps_is_as_declared"},
    SecondHalfIsTheFirst: {"uses_every_sample"},
    RepeatsAreTheFirst: {"repeats_are_independent"},
    SixteenSamples: {"variance_falls_as_one_over_n"},
    OwnSampleInBaseline: {"bias_is_as_declared"},
    OpenLoopScore: {"bias_under_action_feedback"},
    OwnNoise: {"shape_and_repeatability"},
    UndeclaredValue: {"needs_are_truthful"},
    UnusedScore: {"needs_are_truthful"},
    ClaimsJumps: {"bias_across_jumps_is_as_declared"},
    DeniesJumps: {"bias_across_jumps_is_as_declared"},
    LastingBias: {"bias_is_as_declared"},
    RefusesEverything: {"something_was_checked"},
    GradientOfAnotherLaw: {"gradient_is_that_of_value"},
    HalfStiffnessGradient: {"gradient_is_that_of_value"},
    WrongScore: {"score_is_that_of_actions"},
    LeakyColumns: {"columns_are_independent", "value_agrees"},
    ClaimsRoot: {"root_is_differentiated_implicitly"},
    DoubleAnyway: {"single_precision_is_finite"},
    WrongClosedForm: {"closed_form_is_right"},
    ClaimsContinuity: {"continuity_is_as_declared"},
    ClaimsAJump: {"continuity_is_as_declared"},
    ClaimsControls: {"noise_is_where_declared", "closed_form_is_right"},
    MixedColumns: {"costs_are_finite"},
    NumpyOnly: {"backends_agree"},
    PullsTogether: {"contact_geometry_is_consistent"},
    WrongGapRate: {"contact_geometry_is_consistent"},
    Attracts: {"pushes_in_contact", "force_grows_with_penetration"},
    SmoothsNothing: {"does_not_push_from_afar"},
    SecretJump: {"continuity_in_rollouts_is_as_declared"},
    OneSided: {"impulse_keeps_momentum"},
    WrongOrder: {"error_falls_with_declared_order"},
    DropsImpulses: {"takes_impulses_is_truthful"},
    NotADataclass: {"is_frozen_dataclass"},
    Undocumented: {"has_docstring"},
    BadName: {"has_good_name"},
    BareField: {"declares_parameters"},
    RefusedDefault: {"declares_parameters"},
    _local(): {"survives_spawned_process"},
}


@pytest.mark.parametrize("plugin", PLANTED, ids=lambda plugin: plugin.name)
def test_planted_fault_is_caught(plugin):
    failed = {result.check: result.detail for result in check(plugin) if result.outcome == "fail"}
    assert PLANTED[plugin] <= failed.keys(), failed


def test_line_per_check_and_exit_status(capsys):
    assert main(["linear", "explicit_euler"]) == 0
    *lines, empty, summary = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines} <= {"pass", "skip"}
    assert {line.split()[1] for line in lines} == {"linear", "explicit_euler"}
    assert not empty
    assert summary.startswith(f"2 plugins, {len(lines)} checks: ")
    assert " 0 failed" in summary


def test_unavailable_plugin_is_skipped_unless_named(capsys, monkeypatch):
    entry = registry.Entry("scenes", "far_away", None, "not installed: some-dist; pip install some-dist")
    monkeypatch.setattr(registry, "entries", lambda: {"scenes": {"far_away": entry}})
    assert main([]) == 0
    assert main(["far_away"]) == 1
    unnamed, named = (line for line in capsys.readouterr().out.splitlines() if "far_away" in line)
    assert unnamed.startswith("skip")
    assert named.startswith("fail")
    assert "pip install some-dist" in unnamed
    assert "pip install some-dist" in named
