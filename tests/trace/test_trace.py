"""The trace of one rollout: adjoints, contacts, the verdict on spikes, and the command."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from classes import BounceOnce, Complementarity, Implicit, Impulse, Jax, Penalty, Pushing, SemiImplicitEuler

from bench.cli import main
from bench.experiment import config
from bench.experiment.grid import cells
from bench.measure import noise
from bench.measure.contacts import active_contacts, engine_contacts
from bench.model import Decision, FrictionScene, compose
from bench.report.draw import draw
from bench.trace.chart import chart
from bench.trace.sentences import report, verdict
from bench.trace.spikes import align
from bench.trace.trace import COLUMNS, Trace, run, trace


def compiled(scene, contact=None, backend=None):
    return (backend or Jax()).compile(compose(scene, contact, SemiImplicitEuler()))


def drawn(problem, seed=3):
    return np.random.default_rng(seed).standard_normal((problem.program.n_noise, 1))


# ------------------------------------------------------------------------------------------------------ adjoints


@pytest.mark.slow
def test_adjoints_give_the_programs_gradient_through_solved_steps():
    problem = compiled(Pushing(), Complementarity(stiffness=1e3), Implicit())
    assert trace(problem, drawn(problem))[1] < 1e-7


@pytest.mark.slow
def test_a_rollout_with_named_parameters_is_that_of_its_parameters():
    names = ("mass", "penalty.stiffness", "dt")
    program = compose(Pushing(sigma=1e-3), Penalty(stiffness=1e3), SemiImplicitEuler(), Decision(names))
    problem = Jax().compile(program)
    w = drawn(problem)
    table, error = trace(problem, w)
    assert table["time"].iloc[1] == pytest.approx(program.theta0[2] + 1e-3 * w[2, 0], rel=1e-14)
    assert np.isfinite(table["adjoint_norm"]).all()
    assert np.isnan(error)


# ------------------------------------------------------------------------------------------------------- contacts


def test_a_contact_mode_is_predicted_or_measured():
    """Bodies that overlap and already part: the law does not act, and what was measured still calls it a contact."""
    program = compose(BounceOnce(horizon=1, dt=0.1), Impulse(), SemiImplicitEuler())
    controls = np.zeros((1, 0, 3))
    # heights of a ball of radius 0.1 and velocities: parting overlap, free flight, approach within the step
    before, after = [[0.05, 1.0, 0.15], [1.0, -1.0, -1.0]], [[0.15, 0.9, 0.15], [1.0, -1.0, 1.0]]
    states = np.array([before, after])
    forces = np.array([[[0.0, 0.0, 20.0]]])
    assert active_contacts(program, states, controls).tolist() == [[[False, False, True]]]
    assert active_contacts(program, states, controls, forces).tolist() == [[[True, False, True]]]
    soft = compose(program.scene, Penalty(), program.integrator)
    assert active_contacts(soft, states, controls).tolist() == [[[True, False, False]]]


@pytest.mark.slow
def test_contacts_under_a_penalty_by_hand():
    """Four states of a very soft bounce, worked out on paper."""
    scene = BounceOnce(horizon=3, dt=0.5, height=0.6, velocity=-2.0)
    table, _ = trace(compiled(scene, Penalty(stiffness=4.0)), np.zeros((3, 1)))
    # gap 0.5; then v = -2, gap -0.5; force 2, v = -2 + 0.5 * 2 = -1, gap -1; force 4, v = 1, gap -0.5, force 2.
    np.testing.assert_allclose(table["gap"], [0.5, -0.5, -1.0, -0.5], rtol=1e-14)
    np.testing.assert_allclose(table["penetration"], [0.0, 0.5, 1.0, 0.5], rtol=1e-14)
    np.testing.assert_allclose(table["force"], [0.0, 2.0, 4.0, 2.0], rtol=1e-14)
    np.testing.assert_allclose(table["force_peak"], [0.0, 2.0, 4.0, 4.0], rtol=1e-14)
    assert list(table["contacts"]) == [0, 1, 1, 1]
    assert list(table["switch"]) == [0, 1, 0, 0]
    free, touching = [[1.0, 0.5], [0.0, 1.0]], [[1.0 - 4.0 * 0.25, 0.5], [-2.0, 1.0]]
    norms = [np.linalg.norm(matrix, 2) for matrix in (free, touching, touching)]
    np.testing.assert_allclose(table["jacobian_norm"], [*norms, np.nan], rtol=1e-13)
    assert table["sticking"].isna().all()


@pytest.mark.slow
def test_the_impulse_of_a_bounce_is_read_from_the_velocity_jump():
    scene = BounceOnce()
    table, _ = trace(compiled(scene, Impulse()), np.zeros((3, 1)))
    hit = np.flatnonzero(table["contacts"])
    assert len(hit) == 1
    # m (1 + e) v / dt with m = 1 kg, e = 1, v = 2 m/s, dt = 1/480 s
    assert table["force"][hit[0]] == pytest.approx(4 * 480, rel=1e-12)
    assert table["force"].drop(hit[0]).dropna().abs().max() == 0
    assert list(np.flatnonzero(table["switch"])) == [hit[0], hit[0] + 1]


@pytest.mark.parametrize("scene", ["quadruped", "mjcf[file=quadruped.xml,policy=linear]"])
def test_an_engine_reports_the_contacts_of_the_feet(scene):
    """By the collisions of the C engine: of the model's pairs, or of the geoms that its filters let collide."""
    (cell,) = cells(config.load([f"scenes=[{scene}]", "estimators=[fobg]", "backends=[mujoco]", "sweep.horizon=[8]"]))
    problem = cell.backend.compile(cell.program())
    theta, w = problem.program.theta0[:, None], np.zeros((problem.program.n_noise, 1))
    states, controls = problem.trajectory(theta, w)
    contacts = engine_contacts(problem)
    assert {name.lower().replace("back", "rear")[0] for name in contacts.names} == {"f", "r"}
    touching, gaps = contacts.touching(states), contacts.gaps(states)
    assert touching.shape == gaps.shape == (9, 4, 1)
    assert touching.any()
    np.testing.assert_array_equal(touching, gaps < 0)
    forces = contacts.forces(states[:-1], controls)
    assert (forces[touching[:-1]] > 0).all()
    assert not forces[~touching[:-1]].any()


def test_a_spike_is_listed_with_the_switch_beside_it():
    scene = BounceOnce(horizon=40, dt=0.02, height=0.5, velocity=-1.0)
    table, error = trace(compiled(scene, Penalty(stiffness=2e3)), np.zeros((3, 1)))
    said = " ".join(report(table, error))
    first, *_ = np.flatnonzero(table["switch"])
    assert f"contact switches 2, at {first}, " in said
    assert "spikes line up with contact switches" in said or f", at {first}" in said.partition("|dF/dx|")[2]


@pytest.mark.slow
def test_complementarity_forces():
    scene = Pushing(push=1.0)
    law = Complementarity(kappa=1e-8)
    table, _ = trace(compiled(scene, law, Implicit()), np.zeros((30, 1)))
    steps = table.iloc[:-1]
    # On the central path force times gap at the end of the step is kappa.
    np.testing.assert_allclose(steps["force"].to_numpy() * table["gap"].to_numpy()[1:], law.kappa, rtol=1e-6)
    # Bodies pushed together by 1 N at a velocity factor: the second needs half of it once both move alike.
    assert steps["force"].iloc[-1] == pytest.approx(0.5, rel=1e-3)
    assert list(table["contacts"]) == [1] * 31


@dataclass(frozen=True)
class Dragged(BounceOnce, FrictionScene):
    """A bouncing body with a tangential velocity that friction cannot change."""

    friction: float = 0.5
    slip_speed: float = 0.1

    def slip(self, xp, q, v):
        """Fast at first, then at rest."""
        return xp.where(q < 0.05, 0.0 * q, 0.0 * q + 1.0)

    def friction_acceleration(self, xp, q, force):
        """None."""
        return 0.0 * force


def test_stick_and_slip():
    scene = Dragged(horizon=3, dt=0.5, height=0.65, velocity=-1.0)
    table, _ = trace(compiled(scene, Penalty(stiffness=0.1)), np.zeros((3, 1)))
    # gaps 0.55, 0.05, -0.45 and about -0.94; slip ends at height 0.05
    assert list(table["contacts"]) == [0, 0, 1, 1]
    assert list(table["sticking"]) == [0, 0, 1, 1]
    assert list(table["slipping"]) == [0, 0, 0, 0]
    scene = Dragged(horizon=3, dt=0.5, height=0.08, velocity=-0.1)
    table, _ = trace(compiled(scene, Penalty(stiffness=0.1)), np.zeros((3, 1)))
    assert list(table["slipping"]) == [1, 0, 0, 0]
    assert list(table["sticking"]) == [0, 1, 1, 1]
    assert list(table["switch"]) == [0, 1, 0, 0]


@dataclass(frozen=True)
class Itemised(Pushing):
    """Pushing with its stage cost in two parts."""

    def cost_terms(self, xp, q, v, u):
        """Distance and effort."""
        return {"distance": self.terminal_cost(xp, q, v), "effort": u[0] * u[0]}


def test_costs_add_up_to_the_programs_cost():
    problem = compiled(Itemised(), Penalty(stiffness=1e3))
    w = drawn(problem)
    table, _ = trace(problem, w)
    total = table["cost_stage"].sum() + table["cost_terminal"].sum()
    assert total == pytest.approx(problem.value(problem.program.scene.theta0(), w)[0], rel=1e-13)
    np.testing.assert_allclose(table["cost_distance"] + table["cost_effort"], table["cost_stage"], rtol=1e-13)


# ---------------------------------------------------------------------------------------------- spikes and switches


def planted(spike_at=(), switch_at=(), steps=100):
    """A table of quiet norms that rise tenfold at some states and stay there, with contact made or lost at others."""
    norm = np.ones(steps + 1)
    for k in spike_at:
        norm[k:] *= 10.0
    switch = np.zeros(steps + 1, dtype=int)
    switch[list(switch_at)] = 1
    contacts = np.cumsum(switch) % 2
    force = contacts.astype(float)
    return pd.DataFrame(
        {"jacobian_norm": 1.0, "adjoint_norm": norm, "switch": switch, "contacts": contacts, "force": force}
    )


@pytest.mark.parametrize(
    ("spike_at", "switch_at", "found", "said"),
    [
        # two of two draws from the 6 near steps out of 100
        ((30, 61), (30, 60), (2, 2, 0.06, 6 * 5 / (100 * 99)), ": spikes line up with contact switches ("),
        ((10, 80), (30, 60), (2, 0, 0.06, 1.0), "spikes do not line up"),
        ((30,), range(10, 90, 5), (1, 1, 0.48, 0.48), "chance could explain it"),
    ],
)
def test_spikes_near_switches_are_counted_against_chance(spike_at, switch_at, found, said):
    table = planted(spike_at, switch_at)
    assert tuple(align(table["adjoint_norm"], table["switch"])) == pytest.approx(found)
    quiet, spiked = verdict(table)
    assert "no spikes" in quiet
    assert said in spiked


# --------------------------------------------------------------------------------------------------------- command


@pytest.mark.slow
def test_command_writes_table_and_chart(tmp_path, capsys):
    words = [
        "trace",
        "pushing",
        "double_integrator",
        "contacts=[penalty]",
        "contact.penalty.stiffness=1e4",
        "scene.pushing.horizon=60",
        "seed=1",
        f"results_dir={tmp_path}",
    ]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert ": spikes line up with contact switches (" in printed
    for scene, steps in (("pushing", 60), ("double_integrator", 20)):
        directory = tmp_path / "trace" / scene
        assert sorted(path.name for path in directory.iterdir()) == [
            "trace.csv",
            "trace.png",
        ]
        table = pd.read_csv(directory / "trace.csv")
        assert tuple(table.columns[: len(COLUMNS)]) == COLUMNS
        assert len(table) == steps + 1
    assert list(table.columns[len(COLUMNS) :]) == ["q1", "v1", "u1"]


def test_the_seed_draws_the_first_sample_of_the_runs(tmp_path):
    traced = run(config.load(["scenes=[pushing]", "seed=4"]), seeded=True)[0].table
    w = noise.shared(4, "pushing", 3, 8, 30)[0, 0]
    np.testing.assert_allclose(traced["u1"].dropna(), 0.1 + 0.3 * w, rtol=1e-14)
    still = run(config.load(["scenes=[pushing]"]), seeded=False)[0].table
    np.testing.assert_allclose(still["u1"].dropna(), 0.1, rtol=1e-14)


@pytest.mark.slow
def test_a_diverging_rollout_is_drawn_and_told():
    problem = compiled(Pushing(horizon=150, velocity_factor=1e3), Penalty(stiffness=1e3))
    table, error = trace(problem, drawn(problem))
    found = Trace("pushing", "pushing", table, error)
    assert not np.isfinite(table["q1"]).all()
    assert all(isinstance(sentence, str) for sentence in found.report())
    assert len(draw(chart(found)).axes) == 4  # no adjoint is finite


BAD = [
    (["heaviside"], ["heaviside", "no steps"]),
    (["pushing", "backends=[numpy]"], ["numpy", "no step Jacobians", "backends=[jax]"]),
    (["pushing", "contacts=[complementarity]"], ["jax has no root finder", "backends=[implicit]"]),
    (["pushing", "contacts=[penalty,softplus]"], ["2 problems", "one contact law"]),
    (["pushing", "contacts=[impulse]", "integrators=[explicit_euler]"], ["explicit_euler cannot apply the impulses"]),
]


@pytest.mark.parametrize(("words", "said"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_bad_input(words, said, tmp_path, capsys):
    assert main(["trace", *words, f"results_dir={tmp_path / 'out'}"]) == 2
    answer = capsys.readouterr()
    assert answer.out == ""
    assert answer.err.startswith("bench: ")
    assert len(answer.err.strip().splitlines()) == 1
    for part in said:
        assert part in answer.err
    assert not (tmp_path / "out").exists()
