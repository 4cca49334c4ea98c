"""Every registered plugin passes the conformance kit: on few short programs, slowly on a design of crossings, or on all."""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
from classes import Torch
from pairwise import pairwise

from bench import conformance
from bench.conformance import kit, parametrize
from bench.conformance.kit import something_was_checked
from bench.conformance.subjects import (
    all_programs,
    available,
    backends,
    can_run,
    distinguishing_programs,
    plain_backend,
    samples,
    sound_scenes,
)
from bench.conformance.subjects import programs as programs_of
from bench.engines.backend import EngineBackend
from bench.host.identity import changed
from bench.model import (
    Backend,
    ContactScene,
    EngineScene,
    ForceLaw,
    ImpulseLaw,
    MechanicalScene,
    Plugin,
    SampleMean,
    Scene,
    compose,
    registry,
)

STEPS = 50
"""Most steps of a rollout in the fast tests, and as in the slow ones where a scene declares to jump."""
SHORT = 100
"""Most steps of a rollout in the crossings of backends that compile for seconds or run eagerly."""
MOVED = 1e-9
"""Difference of costs of about 1 that is far more than rounding."""
ENTRIES = [entry for table in registry.entries().values() for entry in table.values()]
PLUGINS = [entry.plugin for entry in ENTRIES if entry.plugin is not None]
ITEMS = parametrize(plugin for plugin in PLUGINS if not issubclass(plugin, EngineBackend)).mark.args[1]
"""Engines in environments of their own have ``tests/engines/test_engines_conform.py``."""
GENERIC = {check.__name__ for check in kit._CHECKS[Plugin]}


def kit_items(keep, is_slow=lambda subject, name: False):
    """A test of each of the kit's items whose subject and name of check are to be kept, beside those of any plugin."""
    items = []
    for item in ITEMS:
        subject, name = item.values[0], item.values[1].args[0].__name__
        if name not in GENERIC and keep(subject, name):
            marks = [pytest.mark.slow] * bool(is_slow(subject, name))
            items.append(pytest.param(*item.values, id=item.id, marks=marks))
    return pytest.mark.parametrize(("plugin", "check"), items)


def is_long(plugin, check=""):
    """Whether a check takes long: of backends that compile each program for seconds or run it eagerly, and a few more.

    ``checkpointed`` has tests of its own against ``jax``. A rollout of ``hopper_run`` has 1,920 steps of the integrator, ``surrogate_backward`` solves two equations each step, and
    a search for jumps takes thousands of rollouts of an engine.
    """
    is_slow_backend = {"physics", "root"} & set(getattr(plugin, "provides", ())) or {"torch", "numba"} & set(
        plugin.requires
    )
    is_search = check == "continuity_is_as_declared" and isinstance(plugin, EngineScene)
    return bool(is_slow_backend) or is_search or plugin.name in ("checkpointed", "hopper_run", "surrogate_backward")


def is_varied(plugin):
    """Whether a plugin has other parameters than the defaults."""
    return not isinstance(plugin, type) and plugin != type(plugin)()


def is_repeated(plugin, check):
    """Whether a check without noise ran on the same scene with another place of the noise."""
    return check == "continuity_is_as_declared" and plugin.noise != type(plugin)().noise


def explicit_programs(scene):
    """The scene's programs without an equation to solve."""
    return [program for program in programs_of(scene) if not program.needs_root]


@cache
def shortened(scene):
    """The scene with STEPS steps, or twice as many and so on until theta and the contacts both move its cost.

    Scenes that jump keep theirs, since the jump may come later, and so do those that run in engines only.
    """
    if not isinstance(scene, MechanicalScene) or isinstance(scene, EngineScene) or not scene.continuous:
        return scene
    for doublings in itertools.count():
        horizon = STEPS << doublings
        if horizon >= scene.horizon:
            return scene
        short = dataclasses.replace(scene, horizon=horizon)
        program = explicit_programs(short)[0]
        costs = quiet_costs(program)
        free = quiet_costs(compose(short, None, program.integrator))
        if np.ptp(costs) > MOVED and (program.contact is None or np.abs(costs - free).max() > MOVED):
            return short


def quiet_costs(program):
    """Costs without noise at thetas near theta0, ``(B,)``."""
    theta, w = samples(program)
    return plain_backend().compile(program).value(theta, 0 * w)


@cache
def few_programs(plugin):
    """One short program of each sort that a backend can run; one that takes long has one of each sort of contact law.

    An engine that compiles for seconds has the smallest with contacts and the smallest without.
    """
    programs = [compose(shortened(program.scene), program.contact, program.integrator) for program in all_programs()]
    if isinstance(plugin, Backend):
        programs = [program for program in programs if can_run(plugin, program)]
    if isinstance(plugin, Backend) and plugin.compiles and "physics" in plugin.provides:
        programs.sort(key=lambda program: (program.contact is None, -program.scene.n_q))
        return list({program.contact is None: program for program in programs}.values())
    few = distinguishing_programs(programs)
    return list({sort_of_law(program): program for program in reversed(few)}.values()) if is_long(plugin) else few


def sort_of_law(program):
    law = isinstance(program.contact, ForceLaw), isinstance(program.contact, ImpulseLaw), program.needs_root
    return isinstance(program.scene, MechanicalScene), *law


class Eager(Torch):
    """Torch in place of ``jax``, which compiles a scene's gradient for a tenth of a second and is in the golden cells."""

    compiles = True


oracles = conformance.estimators.oracles


@pytest.fixture
def on_few_programs(monkeypatch):
    """Return what runs a check on one short program of each sort, or every fourth scene with contacts, and few backends."""
    touching = [scene for scene in sound_scenes() if isinstance(scene, ContactScene) and scene.continuous]
    explicit = [method for method in available("integrators") if not method.needs_root]
    monkeypatch.setattr(conformance.scenes, "available", lambda kind: explicit)
    monkeypatch.setattr(conformance.scenes, "backends", lambda: [Eager()])
    # each function at one of the two sizes of the noise, in turn
    monkeypatch.setattr(conformance.estimators, "oracles", lambda: [*oracles()[::4], *oracles()[3::4]])
    monkeypatch.setattr(conformance.estimators, "DESIGNED", 3)

    def few(scene):
        return distinguishing_programs(explicit_programs(shortened(scene)))

    def run(plugin, check):
        scenes = [shortened(scene) for scene in touching[::4]][: 1 if getattr(plugin, "needs_root", False) else None]
        monkeypatch.setattr(conformance.contacts, "sound_scenes", lambda: scenes)
        monkeypatch.setattr(conformance.scenes, "programs", few)
        monkeypatch.setattr(conformance.backends, "all_programs", lambda: few_programs(plugin))
        if isinstance(plugin, Scene):
            monkeypatch.setattr(conformance.subjects, "PARTS", 64)
            plugin = shortened(plugin)
        check(plugin)

    return run


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: f"{entry.kind}-{entry.name}")
def test_registered_plugin_loads_and_is_well_formed(entry):
    assert entry.plugin is not None, entry.reason
    for check in kit._CHECKS[Plugin]:
        check(entry.plugin)


EVERYWHERE = {"mode", "integrator", "gradient", "differences"}
"""Parameters of engines that act without contacts, which are all that the kit runs with other parameters than the defaults."""


REPEATED = ("columns_are_independent", "single_precision_is_finite")
"""Checks that an engine which compiles for seconds has on every program only: they need other batches than its gradient."""


def is_run(plugin, check):
    """Whether a check runs on few short programs: of those that take long with other parameters, gradients only."""
    if not is_long(plugin, check):
        return not is_repeated(plugin, check)
    if check in ("value_agrees", "backends_agree", something_was_checked.__name__):
        return False
    if not is_varied(plugin) or check != "gradient_is_that_of_value":
        is_engine = getattr(plugin, "compiles", False) and "physics" in plugin.provides
        return not is_varied(plugin) and not (is_engine and check in REPEATED)
    return "physics" not in plugin.provides or bool(EVERYWHERE & set(changed(plugin)))


def is_slow(plugin, check):
    """Whether a check is left to the slow tests: a mean of terms has no other variance than one over N."""
    is_mean = check == "variance_falls_as_one_over_n" and isinstance(plugin, SampleMean)
    return is_long(plugin, check) or is_varied(plugin) or is_mean


@kit_items(is_run, is_slow)
def test_registered_plugin_conforms(plugin, check, on_few_programs):
    on_few_programs(plugin, check)


# ----------------------------------------------------------------------------------------------- crossings, slow


@cache
def design():
    """Scene, law and backend of programs in which each pair of these occurs, among those that ``numpy`` runs too."""
    plain = plain_backend()
    runs = [program for program in all_programs() if can_run(plain, program)]
    others = [backend for backend in backends() if type(backend) is not type(plain)]
    return set(pairwise(levels(p, backend) for p in runs for backend in others if can_run(backend, p)))


def levels(program, backend):
    return type(program.scene), type(program.contact), type(backend)


@pytest.fixture
def designed_programs(monkeypatch, plugin, check):
    """Costs on a backend are compared on the programs of the design; a backend that takes long runs short ones."""
    programs = all_programs()
    if is_long(plugin, check):
        programs = [program for program in programs if getattr(program.scene, "horizon", 0) <= SHORT]
    if check.args[0].__name__ == "value_agrees":
        programs = [program for program in programs if levels(program, plugin) in design()]
    monkeypatch.setattr(conformance.backends, "all_programs", lambda: programs)


def is_wider(plugin, check):
    """Whether a check runs more or longer programs than those of one short program of each sort."""
    if check == "value_agrees":
        return not is_varied(plugin) and plugin.name != plain_backend().name
    if is_long(plugin, check):
        return False
    if check == "gradient_is_that_of_value":
        return not is_varied(plugin) and plugin.name != plain_backend().name
    if check in ("costs_are_finite", "gradient_is_finite"):
        return isinstance(plugin, ContactScene)
    if check == "continuity_is_as_declared":
        is_shortened = plugin.continuous and getattr(plugin, "horizon", 0) > STEPS
        return is_shortened and not is_repeated(plugin, check)
    return check == "continuity_in_rollouts_is_as_declared" and not is_varied(plugin)


@pytest.mark.slow
@pytest.mark.usefixtures("designed_programs")
@kit_items(is_wider)
def test_registered_plugin_conforms_on_more_programs(plugin, check):
    check(plugin)


@pytest.mark.full
@kit_items(lambda plugin, check: plugin.kind in ("backends", "scenes", "contacts"))
def test_registered_plugin_conforms_on_every_program(plugin, check):
    check(plugin)
