"""The iterative linear-quadratic regulator: closed forms, planted faults, other optimizers, closed loops and refusals."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from bench.plugins.backends.numpy import Numpy, NumpyProblem
from bench.plugins.optimizers.adam import Adam
from bench.plugins.optimizers.ilqr import Ilqr
from bench.plugins.optimizers.lbfgs import Lbfgs
from bench.plugins.scenes.lqr import Lqr

import bench
from bench.cli import main
from bench.errors import Unsupported
from bench.experiment import config
from bench.measure.solve import solve
from bench.model import Answer, Expansion, Problem, compose, registry, slopes
from bench.run.execute import store_of
from bench.run.plan import plan
from bench.studies.optimise.batched import run_batched

EXACT = 1e-9
"""Relative error of an optimum after one step: first derivatives are known to about 1e-10."""
VISIBLE = 1e-4
"""Relative excess of the cost after one step that a dropped term exceeds."""
AT_REST = 1e-5
"""Norm of a gradient that is 0, relative to the first: differences of NumPy's rollouts have errors of 1e-6."""
SAME = 1e-9
"""Relative difference between rollouts of the same controls by two programs."""


def expanded(problem, theta, backend="numpy"):
    return Ilqr().expansion(problem, registry.make("backends", backend), theta)


def advanced(problem, optimizer, state, backend):
    """Return the state after one request of the optimizer, without noise."""
    still = np.zeros((problem.program.n_noise, 1))
    points = optimizer.ask(state, np.empty((problem.dim, 0)))
    wanted = optimizer.required_fields(state)
    value = problem.value(points, np.repeat(still, points.shape[1], axis=1)) if "value" in wanted else None
    slope = problem.grad(points[:, 0], still) if "gradient" in wanted else None
    path = expanded(problem, points[:, 0], backend) if "path" in wanted else None
    return optimizer.tell(state, points, Answer(value, slope, path=path))


def search(problem, steps, optimizer=None, backend="numpy", watch=lambda state: state):
    """Return the state after some steps from the scene's own theta."""
    optimizer = optimizer or Ilqr()
    state = optimizer.start(problem.program.theta0)
    for _ in range(steps):
        state = watch(advanced(problem, optimizer, state, backend))
    return state


def cost(problem, theta):
    return float(problem.value(theta, np.zeros((problem.program.n_noise, 1)))[0])


def gradient(problem, theta):
    return problem.grad(theta, np.zeros((problem.program.n_noise, 1)))[:, 0]


# ------------------------------------------------------------------------------------------------- closed forms


@dataclass(frozen=True)
class Crossed(Lqr):
    """A regulator whose stage cost has products of state and control, and a linear term."""

    name = "crossed"

    def stage_cost(self, xp, q, v, u):
        """The regulator's cost with cross terms."""
        return super().stage_cost(xp, q, v, u) + 0.05 * q[0] * u[0] + 0.02 * v[0] * u[0] + 0.3 * u[0] + 0.1 * q[0]


def crossed():
    scene = Crossed(horizon=30)
    integrator = registry.make("integrators", "semi_implicit_euler")
    return Numpy().compile(compose(scene, None, integrator))


@pytest.mark.parametrize("backend", ["numpy", "jax"])
def test_one_step_solves_the_regulator(backend):
    problem = bench.problem("lqr", backend=backend)
    least, _ = problem.program.scene.optimum(None, problem.program.integrator)
    assert cost(problem, search(problem, 1, backend=backend)["theta"]) == pytest.approx(least, rel=EXACT)


def test_one_step_solves_a_regulator_with_cross_terms():
    problem = crossed()
    least = solve(problem)
    assert least.certified
    assert cost(problem, search(problem, 1)["theta"]) == pytest.approx(least.cost, rel=EXACT)


def test_controls_of_which_one_is_enough():
    """f = (c . theta - 1)^2 / 2 has many minima. Second derivatives by earlier controls are 0, and damping replaces them."""
    problem = bench.problem("double_integrator", backend="numpy")
    c = problem.program.scene.sensitivity(problem.program.integrator)
    misses = [abs(c @ problem.program.theta0 - 1.0)]
    search(problem, 4, watch=lambda state: misses.append(abs(c @ state["theta"] - 1.0)) or state)
    assert (np.diff(np.log10(misses)) < -2.0).all()  # each step leaves less than a hundredth


def test_a_saddle_is_left_by_damping():
    """Where the second derivatives by a control are negative, the damping grows until they are positive."""
    path = Expansion(
        np.zeros((1, 1)), np.ones((1, 1, 1)), np.zeros((1, 1, 1)), 1.0, np.zeros((2, 1)), np.ones((1, 1)),
        np.zeros((2, 1, 1)), np.zeros((1, 1, 1)), np.full((1, 1, 1), -1.0),
        lambda plans, gains: (plans, 1.0 + plans[0, 0] - 0.5 * plans[0, 0] ** 2),
    )  # fmt: skip
    optimizer = Ilqr()
    state = optimizer.tell(optimizer.start(np.zeros(1)), np.zeros((1, 1)), Answer(path=path))
    assert state["theta"][0] < 0.0
    hopeless = path._replace(cost_uu=np.full((1, 1, 1), -1e12))
    state = optimizer.start(np.zeros(1))
    assert optimizer.tell(state, np.zeros((1, 1)), Answer(path=hopeless)) == state
    uphill = path._replace(follow=lambda plans, gains: (plans, np.full(plans.shape[2], 2.0)))
    after = optimizer.tell(state, np.zeros((1, 1)), Answer(path=uphill))
    assert after["theta"] == state["theta"]
    assert after["damping"] > state["damping"]


def test_second_derivatives_of_a_cost():
    problem = crossed()
    path = expanded(problem, np.linspace(-2.0, 3.0, 30))
    assert path.cost_xx[:-1] == pytest.approx(np.tile(np.diag([2.0, 0.2]), (30, 1, 1)), abs=EXACT)
    assert path.cost_xx[-1] == pytest.approx(np.diag([20.0, 2.0]), abs=1e-8)
    assert path.cost_ux == pytest.approx(np.tile([[0.05, 0.02]], (30, 1, 1)), abs=EXACT)
    assert path.cost_uu == pytest.approx(np.full((30, 1, 1), 0.02), abs=EXACT)


# ------------------------------------------------------------------------------------------------ planted faults


class NoCross(Ilqr):
    """It drops the cross term of the cost."""

    def action_value(self, path, t, value_x, value_xx):
        """Without cost_ux."""
        return super().action_value(path._replace(cost_ux=0.0 * path.cost_ux), t, value_x, value_xx)


class NoCoupling(Ilqr):
    """It drops the product of both Jacobians with the value's second derivative."""

    def action_value(self, path, t, value_x, value_xx):
        """Without b' value_xx a."""
        x, u, xx, _, uu = super().action_value(path, t, value_x, value_xx)
        return x, u, xx, path.cost_ux[t], uu


class NoEnd(Ilqr):
    """It drops the second derivative of the terminal cost."""

    def backward(self, path, damping):
        """Without the last cost_xx."""
        flat = np.concatenate([path.cost_xx[:-1], 0.0 * path.cost_xx[-1:]])
        return super().backward(path._replace(cost_xx=flat), damping)


class NoSlope(Ilqr):
    """It drops the derivative of the stage cost by the state."""

    def action_value(self, path, t, value_x, value_xx):
        """Without cost_x."""
        return super().action_value(path._replace(cost_x=0.0 * path.cost_x), t, value_x, value_xx)


class Transposed(Ilqr):
    """It uses the transpose of a step Jacobian."""

    def backward(self, path, damping):
        """With a' for a."""
        return super().backward(path._replace(a=path.a.transpose(0, 2, 1)), damping)


@pytest.mark.parametrize("fault", [NoCross, NoCoupling, NoEnd, NoSlope, Transposed])
def test_a_planted_fault_misses_the_optimum(fault):
    problem = crossed()
    least, right = solve(problem).cost, cost(problem, search(problem, 1)["theta"])
    assert right - least < EXACT * abs(least)
    assert cost(problem, search(problem, 1, fault())["theta"]) - least > VISIBLE * abs(least)


def test_rollouts_without_gains_fail_where_the_motion_is_unstable():
    """The trial rollouts of a swing of 10 s follow the plan by feedback. Without gains the first search stops far from J*."""

    class Blind(Ilqr):
        def backward(self, path, damping):
            law = super().backward(path, damping)
            return law and (law[0], 0.0 * law[1], *law[2:])

    problem = bench.problem("pendulum_swing", backend="numpy")
    least = 349.490460
    assert cost(problem, search(problem, 6)["theta"]) == pytest.approx(least, rel=1e-6)
    assert cost(problem, search(problem, 6, Blind())["theta"]) > 1.1 * least


# ---------------------------------------------------------------------------------------------- other optimizers


def evaluations(problem, optimizer, share, budget=8000):
    """Return gradients and rollouts until a share of the first regret, or None within a budget; a gradient counts as 4."""
    state, gradients, rollouts = optimizer.start(problem.program.theta0), 0, 0
    least = SWINGS[problem.program.scene.horizon]
    target = least + share * (cost(problem, state["theta"]) - least)
    while rollouts + 4 * gradients < budget:
        if cost(problem, state["theta"]) <= target:
            return gradients, rollouts
        problem.usage.gradients = problem.usage.rollouts = 0
        state = advanced(problem, optimizer, state, "jax")
        gradients, rollouts = gradients + problem.usage.gradients, rollouts + problem.usage.rollouts
    return None


SWINGS = {50: 351.494895783, 200: 349.490460}
"""J* of the swings, by Newton's method."""


@pytest.mark.parametrize(
    ("horizon", "ilqr", "lbfgs", "adam"),
    [
        (50, (2, 20), (8, 136), [183, 57, 49]),
        pytest.param(200, (4, 40), None, [None] * 3, marks=pytest.mark.slow),
    ],
)
def test_gradients_and_rollouts_until_a_thousandth_of_the_regret(horizon, ilqr, lbfgs, adam):
    """The table of docs/controller.md. In 200 steps the others miss a tenth too."""
    pytest.importorskip("jax")
    problem = bench.problem(f"pendulum_swing[horizon={horizon}]", backend="jax")
    assert evaluations(problem, Ilqr(), 1e-3) == ilqr
    share = 1e-3 if horizon == 50 else 0.1
    assert evaluations(problem, Lbfgs(), share) == lbfgs
    expected = [count and (count, 0) for count in adam]
    assert [evaluations(problem, Adam(rate=rate), share) for rate in (0.03, 0.1, 0.3)] == expected


def test_it_ends_no_higher_than_lbfgs_and_adam_on_a_swing():
    problem = bench.problem("pendulum_swing[horizon=50]", backend="numpy")
    theta = search(problem, 10)["theta"]
    first = np.linalg.norm(gradient(problem, problem.program.theta0))
    assert np.linalg.norm(gradient(problem, theta)) < AT_REST * first
    assert cost(problem, theta) == pytest.approx(SWINGS[50], rel=EXACT)
    for other in (search(problem, 120, Lbfgs()), search(problem, 300, Adam(rate=0.1))):
        assert cost(problem, theta) <= cost(problem, other["theta"]) * (1.0 + EXACT)


def test_a_pickled_state_resumes_on_the_same_path():
    problem = bench.problem("pendulum_swing[horizon=20]", backend="numpy")
    resumed = search(problem, 4, watch=lambda state: pickle.loads(pickle.dumps(state)))
    assert np.array_equal(search(problem, 4)["theta"], resumed["theta"])


def test_a_step_counts_as_a_gradient_and_its_trials():
    problem = bench.problem("lqr[horizon=20]", backend="numpy")
    search(problem, 2, Ilqr(tries=7))
    assert (problem.usage.gradients, problem.usage.rollouts) == (2, 14)


# -------------------------------------------------------------------------------------------------- closed loops


@pytest.mark.parametrize("backend", ["numpy", "jax", "torch", "mujoco"])
def test_closed_loops_by_hand(backend):
    """Plans and gains on a backend, and the same feedback loop of this test whose steps are rollouts of one more control."""
    pytest.importorskip(backend)
    problem = bench.problem("pendulum[horizon=6]", backend=backend)
    rng = np.random.default_rng(0)
    nominal = rng.standard_normal(6)
    path = expanded(problem, nominal, backend)
    plans, gains = rng.standard_normal((6, 1, 2)), rng.standard_normal((6, 1, 2))
    controls, costs = path.follow(plans, gains)
    still = np.zeros((6, 1))
    reference = problem.trajectory(nominal, still).states[:, :, 0]
    for b in range(2):
        u = np.zeros(6)
        for t in range(6):
            x = problem.trajectory(u, still).states[t, :, 0]
            u[t] = plans[t, 0, b] + gains[t, 0] @ (x - reference[t])
        assert controls[:, 0, b] == pytest.approx(u, rel=SAME)
        assert costs[b] == pytest.approx(cost(problem, u), rel=SAME)


def test_step_jacobians_of_searches_that_share_batches():
    """Without step Jacobians of the backend they are differences, in a shared problem too."""
    problem = bench.problem("lqr[horizon=5]", backend="numpy")
    theta, still = np.ones(5), np.zeros((5, 1))
    (shared,) = run_batched(problem, [lambda lane: {"a": slopes(lane, theta, still).a}])
    assert np.array_equal(shared["a"], slopes(problem, theta, still).a)


# ----------------------------------------------------------------------------------------------------- the study


WORDS = ["name=none", "estimators=[fobg]", "optimizers=[ilqr]", "backends=[numpy]", "samples=2", "repeats=2"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["study=optimise", "scenes=[quadratic]"], "plans the controls of each step, and scene quadratic has no time steps"),
        (["study=optimise", "scenes=[cartpole]"], "plans the controls of each step, which are not theta in scene cartpole"),
        (["study=optimise", "scenes=[lqr]", "theta=[start]"], "theta must be the scene's own, not ['start']"),
        (["study=optimise", "scenes=['pushing[hold=2]']"], "scene pushing holds each for several: set hold=1"),
        (["study=optimise[scored=smoothed]", "scenes=[lqr]"], "minimises the cost without noise, and scored=smoothed is another objective"),
        (["study=identify", "scenes=[sliding_block]"], "plans controls, and fits have parameters: use gauss_newton"),
        (["study=dose_response", "scenes=[lqr]"], "needs path, which this study does not compute"),
    ],
)  # fmt: skip
def test_refused_when_planned(tmp_path, words, reason):
    experiment = config.load([*WORDS, *words, f"results_dir={tmp_path}"])
    (item,) = plan(experiment, store_of(experiment))
    assert item.refusal is not None
    assert item.refusal[1].startswith("optimizer ilqr") or item.refusal[1].startswith("ilqr")
    assert reason in item.refusal[1]


def test_a_backend_without_states_is_refused():
    class Unseen(NumpyProblem):
        trajectory = Problem.trajectory

    @dataclass(frozen=True)
    class UnseenBackend(Numpy):
        def compile(self, program):
            return Unseen(program, "float64", 1e-6)

    problem = UnseenBackend().compile(bench.problem("lqr[horizon=5]", backend="numpy").program)
    path = Ilqr().expansion(problem, UnseenBackend(), np.zeros(5))
    with pytest.raises(Unsupported, match="does not expose the states"):
        path.follow(np.zeros((5, 1, 1)), np.zeros((5, 1, 2)))


@pytest.mark.parametrize("words", [["workers=0", "timing=false"], ["workers=1", "timing=false"], ["workers=0"]])
def test_a_search_in_any_process(tmp_path, words):
    scenes = ["scenes=['lqr[horizon=20]']", "study=optimise[iterations=2]", "sweep.seed=[0,1]"]
    assert main([*WORDS, *scenes, *words, f"results_dir={tmp_path}"]) == 0
    rows = bench.load(tmp_path / "none")
    assert (rows["status"] == "ok").all()
    assert rows["estimator"].fillna("").eq("").all()
    assert rows["final_cost"].to_numpy() == pytest.approx(rows["optimum"].to_numpy(), rel=EXACT)
    assert (rows["gradients"] == 2).all()
    assert (rows["rollouts"] == 20).all()
