"""Engines in another Python: equal numbers, nothing lost when they die, one message where the environment is missing."""

import dataclasses
import os
import pickle
import shutil
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import psutil
import pytest
from classes import (
    BounceOnce,
    BouncingBall,
    Cartpole,
    Hopper,
    Impulse,
    Numpy,
    Penalty,
    Pushing,
    Rk4,
    SemiImplicitEuler,
)

import bench
from bench.cli import main
from bench.conformance import backends, subjects
from bench.conformance.kit import Failed
from bench.conformance.subjects import law_for
from bench.engines import environments, process, server, twin
from bench.engines.process import close_engines
from bench.errors import Crashed, Unsupported
from bench.experiment import by_name
from bench.experiment.keys import fingerprint
from bench.model import Problem, compose, registry

pytest.importorskip("mujoco", reason="reads twins")
TOYS = Path(__file__).parent / "toys"
HERE = sys.executable
PATHS = [str(TOYS.parent), str(TOYS.parents[1])]  # of this file and of `classes`, for a run of its own
SMALL = ["samples=4", "repeats=4", "timing=false", "reference.samples=256", "reference.tolerance=1", "--quiet"]
SETTINGS = ["scenes=[bouncing_ball]", "contacts=[penalty]", "scene.bouncing_ball.horizon=40", f"plugins={TOYS}", *SMALL]


@pytest.fixture(autouse=True)
def toys():
    registry.add_folder(TOYS)


@pytest.fixture(autouse=True, scope="module")
def ended():
    """End the engine, which the tests share, after the last one."""
    yield
    close_engines()


def toy(**values):
    return registry.usable("backends", "toy")(python=HERE, **values)


def program(scene, law=Penalty):
    own = law_for(scene, law) if isinstance(law, type) else law
    return compose(scene, own if scene.n_contacts else None, SemiImplicitEuler())


def noise(problem, columns=5):
    return np.random.default_rng(0).standard_normal((problem.program.n_noise, columns))


# --------------------------------------------------------------------------------------------------------- numbers


class Running(BouncingBall):
    """A ball with costs of all steps."""

    def stage_cost(self, xp, q, v, u):
        return q[0] ** 2 + 0.1 * v[0] ** 2


@pytest.mark.parametrize("scene", [BounceOnce(), BouncingBall(), Running()], ids=lambda s: type(s).__name__)
def test_costs_and_gradients_equal_those_of_this_process(scene):
    ours, theirs = Numpy().compile(program(scene)), toy().compile(program(scene))
    w = noise(ours)
    np.testing.assert_allclose(theirs.value(ours.program.theta0, w), ours.value(ours.program.theta0, w), rtol=1e-12)
    np.testing.assert_allclose(theirs.grad(ours.program.theta0, w), ours.grad(ours.program.theta0, w), atol=1e-6)


def test_calls_are_counted_and_compilation_is_charged_once():
    problem = toy().compile(program(BouncingBall()))
    problem.grad(problem.program.theta0, noise(problem))
    first = problem.usage.compile_s
    problem.grad(problem.program.theta0, noise(problem))
    assert problem.usage.compile_s == first > 0
    assert problem.engine_s > 0
    assert problem.pipe_s > 0
    assert problem.peak_memory_mb > 10


def test_settings_that_change_the_last_digits_are_those_of_the_engines_process(monkeypatch):
    close_engines()
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1")
    problem = toy().compile(program(BouncingBall()))
    assert problem.settings == {}
    problem.value(problem.program.theta0, noise(problem))
    assert problem.settings["XLA_FLAGS"] == "--xla_a=1"
    assert int(problem.settings["processors"]) >= 1
    assert problem.settings["speed"] == "slow"


def test_two_programs_share_one_process_of_the_engine():
    problems = [toy().compile(program(scene)) for scene in (BounceOnce(), BouncingBall())]
    for problem in problems * 2:
        problem.value(problem.program.theta0, noise(problem))
    assert len(process._running) == 1


def test_a_model_that_the_engine_has_dropped_is_built_again():
    """An engine stores its last models only."""
    problems = [toy().compile(program(BouncingBall(horizon=2 + i))) for i in range(6)]
    values = [problem.value(problem.program.theta0, noise(problem)) for problem in problems]
    for problem, value in zip(problems, values, strict=True):
        np.testing.assert_array_equal(problem.value(problem.program.theta0, noise(problem)), value)


@pytest.mark.parametrize("scene", [Hopper(), Pushing(), BouncingBall()], ids=lambda s: s.name)
def test_forces_of_a_twin_are_those_of_the_scene(scene):
    """Of bodies on slides: gravity plus the forces of motors, springs and dampers by mass is the scene's acceleration."""
    model, rng = twin.read(scene.mjcf()), np.random.default_rng(0)
    q, v, u = (rng.uniform(-1, 1, (n, 3)) for n in (scene.n_q, scene.n_q, scene.n_u))
    taker = type("Taker", (), {"takes_forces": True})
    force = server.Controlled(taker, model["forces"])._input(np.concatenate([q, v]), u)
    masses, axes = (np.array([body[name] for body in model["bodies"]]) for name in ("mass", "axis"))
    acceleration = force / masses[:, None] + (axes @ np.array(model["gravity"]))[:, None]
    damped = 1.0 - getattr(scene, "velocity_factor", 1.0)
    expected = scene.acceleration(np, q, v, u) - damped * v / scene.dt
    np.testing.assert_allclose(acceleration, expected, rtol=1e-12)


def test_a_twin_with_other_elements_is_refused_by_their_name():
    with pytest.raises(Unsupported, match="joint with frictionloss"):
        twin.read(
            '<worldbody><body><joint name="a" type="slide" frictionloss="1"/><geom type="sphere"/></body></worldbody>'
        )
    with pytest.raises(Unsupported, match="the twin has equality"):
        twin.read("<worldbody/><equality/>")


# ---------------------------------------------------------------------------------------------------------- deaths


def test_an_engine_that_is_killed_is_started_again_and_the_call_repeated():
    problem = toy().compile(program(BouncingBall()))
    before = problem.grad(problem.program.theta0, noise(problem))
    (engine,) = process._running.values()
    os.kill(engine.process.pid, signal.SIGKILL)
    np.testing.assert_array_equal(problem.grad(problem.program.theta0, noise(problem)), before)
    (other,) = process._running.values()
    assert other.process.pid != engine.process.pid


def test_an_engine_that_dies_again_is_a_crash_with_its_signal_and_last_output():
    problem = toy(fault="exit").compile(program(BouncingBall()))
    with pytest.raises(
        Crashed, match=r"toy ended twice during jacobians: killed by SIGKILL; its last output: .*another"
    ):
        problem.grad(problem.program.theta0, noise(problem))


def test_an_error_in_an_engine_names_its_file_and_line_and_the_engine_goes_on():
    problem = toy(fault="raise").compile(program(BouncingBall()))
    with pytest.raises(process.EngineError, match=r"ValueError: the engine has a fault \(toy.py:\d+ < toy.py:\d+\)"):
        problem.grad(problem.program.theta0, noise(problem))
    assert np.isfinite(problem.value(problem.program.theta0, noise(problem))).all()
    assert len(process._running) == 1


@pytest.mark.slow
def test_an_engine_ends_with_its_run_even_if_it_hangs():
    code = f"""
import sys, threading, time
sys.path[:0] = {PATHS!r}
from test_other_python import BouncingBall, noise, process, program, registry, toy, TOYS
registry.add_folder(TOYS)
problem = toy(fault="loop").compile(program(BouncingBall()))
threading.Thread(target=lambda: problem.grad(problem.program.theta0, noise(problem)), daemon=True).start()
while not problem.engine_s:
    time.sleep(0.05)
print(next(iter(process._running.values())).process.pid, flush=True)
time.sleep(100)
"""
    with subprocess.Popen([HERE, "-c", code], stdout=subprocess.PIPE, text=True) as run:
        engine = psutil.Process(int(run.stdout.readline()))
        run.kill()
        assert engine.wait(300) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "limit", "status", "reason"),
    [
        ("loop", "timeout=10s", "timeout", "no result within 10 s"),
        ("memory", "memory=1G", "crashed", "more than 1 GiB of memory"),
    ],
)
def test_limits_of_a_cell_count_its_engine(tmp_path, fault, limit, status, reason):
    """A cell whose engine hangs or takes too much memory is stopped with its engine, and the other cells run."""
    close_engines()
    backends = f"backends=[numpy,'toy[python={HERE},fault={fault}]']"
    words = ["name=limits", *SETTINGS, backends, "estimators=[fobg]", "workers=1", limit, f"results_dir={tmp_path}"]
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    assert main(words) in (0, 1)
    rows = bench.load(tmp_path / "limits").set_index(bench.load(tmp_path / "limits")["backend"].str[:3])
    assert rows.loc["num", "status"] == "ok"
    assert rows.loc["toy", "status"] == status
    assert reason in rows.loc["toy", "reason"]
    assert {child.pid for child in psutil.Process().children(recursive=True)} <= before
    assert not [
        p for p in psutil.process_iter(["cmdline"]) if str(TOYS / "engines") in " ".join(p.info["cmdline"] or ())
    ]


# ---------------------------------------------------------------------------------------------------- environments


def test_a_missing_environment_is_one_message_with_its_command(tmp_path, monkeypatch):
    monkeypatch.setenv(environments.FOLDER, str(tmp_path))
    words = ["name=missing", *SETTINGS, "backends=[toy]", "estimators=[fobg,reinforce]", f"results_dir={tmp_path}"]
    assert main(words) == 0
    rows = bench.load(tmp_path / "missing")
    assert set(rows["status"]) == {"unavailable"}
    assert set(rows["reason"]) == {
        "engine toy: it is not installed; make its environment with `python -m bench engines install toy`"
    }


@pytest.mark.parametrize(
    ("python", "reason"),
    [
        ("/nowhere/python", "python=/nowhere/python: the file does not exist; make"),
        (shutil.which("true"), "it is not a working Python"),
        ("/etc/passwd", "it cannot be started"),
    ],
)
def test_a_wrong_python_is_named(python, reason):
    assert reason in dataclasses.replace(toy(), python=python).unavailable_reason()


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setattr(type(toy()), "libraries", ("numpy", "no_such_library"))
    assert "has no no_such_library; make its environment" in toy().unavailable_reason()


@pytest.mark.slow
def test_versions_of_the_other_python_are_in_the_row(tmp_path):
    words = ["name=versions", *SETTINGS, f"backends=['toy[python={HERE}]']", "estimators=[fobg]", "workers=0"]
    assert main([*words, f"results_dir={tmp_path}"]) == 0
    (versions,) = bench.load(tmp_path / "versions")["versions"]
    python = ".".join(map(str, sys.version_info[:3]))
    assert (
        versions == f"numpy={np.__version__};mujoco={version('mujoco')};toy:python={python};toy:numpy={np.__version__}"
    )


REFUSED = {
    "install toy": "has no file of requirements",
    "install newtom": "did you mean 'newton'",
    "install jax==1": "has no file of requirements",
    "install newton==": "newton== has no release",
    "install broken": "No module named 'no_such_library'",
    "remove": "engines: remove is not a request",
    "metamorphic FILE mujoco==9.9": "engines install mujoco==9.9",
    "metamorphic FILE brax": "engine brax: it is not installed",
    "metamorphic FILE broken": "No module named 'no_such_library'",
    "metamorphic FILE jax": "jax is not an engine",
    "metamorphic FILE steps=0": "steps=0 is not a setting",
    "metamorphic FILE mujoco mjx": "mjx is not a setting",
    "table mujoco sampels=4": "engine_gradients refuses sampels=4",
}


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """A folder of plugins with the toy, and with a backend that cannot be imported."""
    monkeypatch.setenv(environments.FOLDER, str(tmp_path))
    shutil.copytree(TOYS, tmp_path / "plugins")
    text = "import no_such_library\nfrom bench.plugin import EngineBackend\n"
    (tmp_path / "plugins" / "broken.py").write_text(text)
    return f"plugins={tmp_path / 'plugins'}"


def test_the_command_lists_engines_and_says_what_it_cannot_do(broken, capsys):
    assert main(["engines", broken]) == 0
    assert "install newton" in capsys.readouterr().out
    for words, text in REFUSED.items():
        assert main(["engines", *words.replace("FILE", __file__).split(), broken]) == 2
        assert text in capsys.readouterr().err, words


@pytest.mark.parametrize(
    ("word", "wanted"),
    [
        ("mujoco", "-r FILE"),
        ("mujoco==4.0.0", "mujoco==4.0.0"),
        ("mujoco==newest", "--upgrade mujoco"),
        ("newton==newest", "--upgrade newton"),
    ],
)
def test_another_release_has_an_environment_of_its_own(word, wanted, tmp_path, monkeypatch):
    """The other pins of a file of requirements are those of its own release."""
    monkeypatch.setenv(environments.FOLDER, str(tmp_path))
    calls = []
    monkeypatch.setattr(environments.subprocess, "run", lambda words, **options: calls.append(words))
    file = tmp_path / "requirements.txt"
    file.write_text(f"{word.partition('==')[0]}==1.0\nwarp-lang==1.19.0\n")
    assert environments.install(word, file) == tmp_path / word
    assert calls[0][-1] == str(tmp_path / word)
    assert " ".join(calls[1][6:]) == wanted.replace("FILE", str(file))


def test_a_release_without_an_environment_has_the_command_that_makes_it(tmp_path, monkeypatch):
    monkeypatch.setenv(environments.FOLDER, str(tmp_path))
    assert main(["engines", "table", "mujoco==9.9", f"out={tmp_path / 'out'}"]) == 0
    assert "engines install mujoco==9.9" in (tmp_path / "out" / "engines.csv").read_text()


# ------------------------------------------------------------------------------------------------------- contracts


def test_an_engine_that_ignores_a_contact_fails_the_kit():
    assert "m/s" in backends.pressed_contact_pushes(toy())
    with pytest.raises(Failed, match="the velocity away changes by 0"):
        backends.pressed_contact_pushes(toy(fault="no_contact"))


def test_files_of_engines_are_neither_imported_nor_listed():
    names = {name for table in registry.entries().values() for name in table}
    assert {"newton", "drake", "toy"} <= names
    own = {name for name in sys.modules if name.startswith("bench.plugins.engines.")}
    assert not [name for name in own if not name.endswith("_conformance")]
    assert "bench_engine_model" not in sys.modules
    assert not [name for name in sys.modules if name.startswith("bench_folder_") and ".engines." in name]
    assert not {"warp", "pydrake", "brax", "taichi"} & set(sys.modules)


def test_a_change_of_an_engines_file_or_of_what_it_imports_changes_the_key(tmp_path):
    names = []
    for text, imported in ("", ""), ("CHANGED = True", ""), ("import extra", ""), ("import extra", "CHANGED = True"):
        folder = tmp_path / f"toys{len(names)}"
        shutil.copytree(TOYS, folder)
        with (folder / "engines" / "toy.py").open("a") as file:
            file.write(f"\n{text}\n")
        (folder / "engines" / "extra.py").write_text(imported)
        registry._folders.clear()
        registry.add_folder(folder)
        names.append(fingerprint(toy()))
    assert len(set(names)) == 4


@dataclasses.dataclass(frozen=True)
class Leaning(BounceOnce):
    """Its slide leans to the ground, so that friction would act on the contact."""

    name = "leaning"

    def mjcf(self):
        return super().mjcf().replace('axis="0 0 1"', 'axis="1 0 1"')


@pytest.mark.parametrize(
    ("engine", "scene", "law", "reason"),
    [
        ("taichi", Cartpole(), Penalty, "slides only"),
        ("taichi", by_name.make("scenes", "wall_penalty_1d"), Penalty(damping=0.0), "taichi's ground is z = 0"),
        ("drake", by_name.make("scenes", "wall_penalty_1d"), Penalty, None),
        ("newton", Cartpole(), Penalty, None),
        ("newton", BouncingBall(), Penalty(damping=1.0), "supports damping_mode=approach only, not clipped"),
        ("newton[solver=semi_implicit]", Cartpole(), Penalty, "semi_implicit solver has no joint coordinates"),
        ("newton[solver=semi_implicit]", BouncingBall(), Impulse, "replaces penalty, not impulse"),
        ("newton[solver=xpbd]", Cartpole(), Penalty, "xpbd solver has no joint coordinates"),
        ("newton[solver=xpbd]", BouncingBall(), Penalty, "replaces impulse, not penalty"),
        ("newton[solver=xpbd]", BouncingBall(), Impulse, None),
        ("genesis", Leaning(), Penalty, "along the slides of their bodies only"),
        *(
            ("genesis", scene, Penalty, None)
            for scene in (BounceOnce(), BouncingBall(), Pushing(), Hopper(), Cartpole())
        ),
    ],
)
def test_programs_that_an_engine_does_not_run_are_refused(engine, scene, law, reason):
    found = by_name.make("backends", engine).refusal(program(scene, law))
    assert found is None if reason is None else reason in found


def test_an_integrator_that_an_engine_does_not_replace_is_refused():
    refused = toy().refusal(compose(BouncingBall(), law_for(BouncingBall(), Penalty, {}), Rk4()))
    assert "replaces semi_implicit_euler, not rk4" in refused


def test_a_rigid_solver_has_no_gradients():
    rigid, spring = (by_name.make("backends", f"newton[solver={name}]") for name in ("xpbd", "featherstone"))
    assert spring.provides - rigid.provides == {"grad"}
    assert (
        pickle.loads(pickle.dumps(rigid)).provides == dataclasses.replace(rigid, python=HERE).provides == rigid.provides
    )


def test_only_an_engine_that_declares_an_error_of_its_solver_may_differ_by_it(monkeypatch):
    """And only where there are contact forces to solve for."""
    allowed = [(program(BounceOnce()), 1e-9 + 1e-6), (program(Cartpole()), 1e-9)]
    assert [backends._allowed(toy(), of, 1e-9) for of, _ in allowed] == [1e-9, 1e-9]
    monkeypatch.setattr(type(toy()), "solver_error", 1e-6)
    assert [backends._allowed(toy(), of, 1e-9) for of, _ in allowed] == pytest.approx([error for _, error in allowed])


def test_a_pull_gives_the_jacobians_of_the_controls():
    class Pulled:
        """Steps x + u^2 for forces u, with products of their derivatives."""

        takes_forces = True

        @staticmethod
        def pull(x, force, slope):
            return slope, 2 * force * slope[:1]

    forces = {"constant": [0.5], "by_state": [[2.0, 3.0]], "by_control": [[4.0]]}
    x, u = np.random.default_rng(0).standard_normal((2, 5)), np.ones((1, 5))
    (a, b), _ = server.Controlled(Pulled(), forces).call("jacobians", x, u)
    force = 2 * (0.5 + 2 * x[0] + 3 * x[1] + 4)
    np.testing.assert_allclose(a, [[1 + 2 * force, 3 * force], [0 * force, 1 + 0 * force]])
    np.testing.assert_allclose(b, [[4 * force], [0 * force]])


def test_a_state_that_is_not_finite_does_not_reach_the_engine():
    problem, x = toy().compile(program(BounceOnce())), np.array([[1.0], [0.0]])
    (after,) = problem.call("step", np.concatenate([x, np.nan * x], axis=1), np.zeros((1, 2)))
    assert np.isfinite(after[:, 0]).all()
    assert np.isnan(after[:, 1]).all()


# ------------------------------------------------------------------------------------------------------------- kit


def test_the_kit_compares_with_numpy_although_engines_are_installed(monkeypatch):
    """An engine requires no library of this Python and compiles nothing here, but it is not the scene's own program."""
    installed = subjects.available
    engine = type(toy())
    monkeypatch.setattr(subjects, "available", lambda kind: [engine] * (kind == "backends") + installed(kind))
    subjects.plain_backend.cache_clear()
    try:
        assert subjects.plain_backend() == Numpy()
        assert subjects.able_backend(program(BouncingBall())) == Numpy()
    finally:
        subjects.plain_backend.cache_clear()


def test_a_problem_without_what_its_backend_does_not_provide_says_so():
    class CostOnly(Problem):
        """Costs only."""

        def _value(self, theta, w):
            return (theta + 0.0 * w[:1]).sum(axis=0)

    problem = CostOnly(compose(Cartpole(), None, SemiImplicitEuler()))
    w = noise(problem)
    assert problem.value(problem.program.theta0, w).shape == (5,)
    with pytest.raises(Unsupported, match=r"CostOnly computes no gradients: define CostOnly\._grad"):
        problem.grad(problem.program.theta0, w)
    with pytest.raises(
        Unsupported, match=r"CostOnly computes no scores: define CostOnly\._score, or leave 'score' out"
    ):
        problem.score(problem.program.theta0, w)
