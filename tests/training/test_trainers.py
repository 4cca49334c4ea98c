"""Trainers: runs that resume bit for bit, PPO on a problem with a closed form, gradients of both orders that agree."""

import os
import pickle
import subprocess
import sys
from dataclasses import dataclass

import equinox
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bench.plugins.studies.train.measure import slope_errors
from bench.plugins.studies.train.verdicts import DISAGREES
from bench.plugins.trainers.shac import Shac
from problems import Untouched, cartpole_program, environment, pressed_program
from scipy.stats import norm
from trees import ROOT

from bench.model import Answer, registry
from bench.training.agreement import cosine
from bench.training.networks import Actor
from bench.training.run import Training

SMALL = {"hidden": 8, "steps": 4000}
TRAINERS = {
    "shac": {**SMALL, "rollouts": 4, "window": 5, "passes": 2, "batches": 2},
    "bptt": {**SMALL, "rollouts": 4},
    "ppo": {**SMALL, "rollouts": 4, "window": 5, "passes": 2, "batches": 2},
    "evolution": {**SMALL, "population": 4},
    "sep_cma_es": {**SMALL, "population": 4},
}


def training(name, dtype="float64", horizon=12, substeps=1, **parameters):
    env = environment(cartpole_program(horizon=horizon, substeps=substeps), dtype=dtype)
    return Training(env, registry.make("trainers", name, {**TRAINERS[name], **parameters}))


@pytest.mark.parametrize(
    "name", [name if name == "shac" else pytest.param(name, marks=pytest.mark.slow) for name in TRAINERS]
)
def test_a_run_that_is_stored_and_resumed_takes_the_same_path_bit_for_bit(name):
    run = training(name, "float32")

    def followed(is_stored):
        state, logs = run.start(3), []
        for update in range(4):
            if update == 2 and is_stored:
                state = pickle.loads(pickle.dumps(jax.device_get(state)))
            state, log = run.update(state)
            logs.append({key: float(value) for key, value in log.items()})
        return logs, jax.tree.leaves(jax.device_get(state))

    (whole, last), (again, same) = followed(False), followed(True)
    assert whole == again
    for a, b in zip(last, same, strict=True):
        assert np.array_equal(a, b)
        assert np.asarray(a).dtype != np.float64, "a float32 run computes in float32"


@pytest.mark.slow
def test_the_first_step_of_sep_cma_es_is_the_diagonal_of_that_of_cma_es():
    """From equal variances both draw the same points; learning rates of the variances differ by (d + 2) / 3."""
    run = training("sep_cma_es", population=6)
    state = jax.device_get(run.start(3))
    key, key_points, key_start, key_rollout = jax.random.split(state.key, 4)
    y = np.asarray(run.env.normal(key_points, (6, state.theta.size)))
    points = state.theta + state.sigma * y
    numbers = jnp.broadcast_to(run.env.normal(key_start, (run.env.n_start, 1)), (run.env.n_start, 6))
    total, *_ = run.trainer.returns(run.env, state, points, run.env.start(numbers), (key, key_rollout))
    full = registry.make("optimizers", "cma_es", {"width": 0.05})
    expected = full.tell(full.start(state.theta), points.T, Answer(value=-np.asarray(total)))
    after, _ = run.update(run.start(3))
    np.testing.assert_allclose(after.theta, expected["theta"], rtol=1e-9)
    assert float(after.sigma) == pytest.approx(expected["sigma"], rel=1e-9)
    change = np.diag(expected["covariance"]) - 1.0
    np.testing.assert_allclose(after.variance - 1.0, change * (state.theta.size + 2) / 3, rtol=1e-6, atol=1e-9)


WRONG = {
    "none": lambda g: g,
    "half of the units": lambda g: g.at[::2].set(0.0),
}


@dataclass(frozen=True)
class Planted(Shac):
    """SHAC whose second layer of weights moves along a wrong gradient."""

    fault: str = "none"

    def actor_optimizer(self, env):
        def place(actor):
            return actor.mean.weights[1]

        plant = optax.stateless(lambda g, _: equinox.tree_at(place, g, WRONG[self.fault](place(g))))
        return optax.chain(plant, super().actor_optimizer(env))


@pytest.mark.parametrize("fault", ["half of the units", pytest.param("none", marks=pytest.mark.slow)])
def test_a_layer_that_moves_along_a_wrong_gradient_is_named(fault):
    env = environment(cartpole_program(horizon=12, substeps=1))
    exact = Training(env, Planted(**TRAINERS["shac"], fault=fault))
    errors = np.array(slope_errors(exact, exact.start(0)))
    is_second = np.arange(errors.size) == 1
    assert (errors[~is_second] < 1e-4).all()
    assert (errors[is_second] > DISAGREES).all() == (fault != "none")


@pytest.mark.slow
def test_windows_have_no_bias_where_actions_move_nothing_and_one_where_they_do():
    """Without dynamics every action is rewarded at once, so that neither a cut nor a wrong critic changes the gradient."""

    def gradients(env):
        run = Training(env, registry.make("trainers", "shac", TRAINERS["shac"]))
        state = run.start(0)
        return run.gradient(state, 1, 12), run.gradient(state, 1, 12, 12), run.gradient(state, 1, 12, 5)

    whole, same, cut = gradients(environment(pressed_program(scene=Untouched(horizon=12))))
    np.testing.assert_allclose(same, whole, rtol=1e-10)
    np.testing.assert_allclose(cut, whole, rtol=1e-10, atol=1e-10 * np.abs(whole).max())
    whole, same, cut = gradients(environment(cartpole_program(horizon=12, substeps=1)))
    np.testing.assert_allclose(same, whole, rtol=1e-10)
    assert np.linalg.norm(cut - whole) > 1e-3 * np.linalg.norm(whole)


@pytest.mark.slow
def test_first_and_zeroth_order_gradients_of_a_window_agree():
    """Both estimate the derivative of the same objective: with enough rollouts their cosine is 1."""
    run = training("shac", "float32")
    cosines = run.agreement(run.start(0), 1, 256)
    assert cosines["cosine_denoised"] == pytest.approx(1.0, abs=0.02)  # eight times its spread over seeds


def test_a_planted_first_order_gradient_of_the_wrong_sign_is_seen_in_the_cosine():
    key = jax.random.PRNGKey(0)
    theta = jnp.array([0.5])

    def parts(sign):
        def of(actor, key):
            noise = jax.random.normal(key, (1, 256))
            action = jax.lax.stop_gradient(theta)[:, None] + noise
            through = actor[:, None] + noise
            # values are the same in both; the planted one passes the derivative on with the wrong sign
            gained = -((jax.lax.stop_gradient(2 * through) - through) ** 2) if sign < 0 else -(through**2)
            return gained, jnp.ones((1, 256), bool), -((action - actor[:, None]) ** 2) / 2

        return of

    assert float(cosine(parts(1), theta, key, 64)["cosine"]) == pytest.approx(1.0)
    assert float(cosine(parts(-1), theta, key, 64)["cosine"]) == pytest.approx(-1.0)


@pytest.mark.slow
def test_the_slope_of_ppo_is_that_of_its_clipped_objective():
    """For normal actions of a linear policy of a constant, half of whose ratios are beyond the range, against differences."""
    trainer = registry.make("trainers", "ppo", {"range": 0.2, "entropy": 0.1})
    actor = Actor(jax.random.PRNGKey(0), [1, 1], "float64")
    action, change, advantage = np.random.default_rng(0).standard_normal((3, 50))
    seen = np.ones((1, 50))
    at = np.array([float(actor.mean(seen[:, :1])[0, 0]), float(actor.log_deviation[0, 0])])
    old = norm.logpdf(action, at[0], np.exp(at[1])) + 0.3 * change

    def loss(mean, log_deviation):
        ratio = np.exp(norm.logpdf(action, mean, np.exp(log_deviation)) - old)
        gained = np.minimum(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage)
        return -gained.mean() - 0.1 * log_deviation

    slope = jax.grad(trainer.surrogate)(actor, seen, action[None], old, advantage)
    found = [float(slope.mean.biases[0][0, 0]), float(slope.log_deviation[0, 0])]
    expected = [(loss(*(at + h)) - loss(*(at - h))) / 2e-6 for h in 1e-6 * np.eye(2)]
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_critic_of_ppo_stays_within_the_returns_that_rewards_allow():
    """Its unit comes from rewards alone: one that also depends on its values grows with them."""
    run = training("ppo", "float32", rollouts=8, window=64, batches=8, passes=10, critic_rate=1e-2)
    state, largest = run.start(0), 0.0
    for _ in range(run.trainer.updates(run.env)):
        state, log = run.update(state)
        largest = max(largest, -float(log["reward"]))
    assert float(log["value_loss"]) < (largest / (1 - run.trainer.discount)) ** 2


@pytest.mark.slow
def test_training_leaves_a_failed_solve_of_the_implicit_backend_in_its_column():
    code = "import os, bench.training.networks; print(os.environ['EQX_ON_ERROR'])"
    environ = {name: value for name, value in os.environ.items() if name != "EQX_ON_ERROR"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environ, cwd=ROOT)
    assert done.stdout.strip() == "off", done.stderr
