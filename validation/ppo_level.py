"""Compares `ppo` with an independent PPO on the cart-pole: `python validation/ppo_level.py [SEEDS] [STEPS]`.

The independent one shares no code: own dynamics, rewards, networks, advantages and update, with the same settings. Prints
the final returns of both over the same 256 starts, and the difference of their means with Welch's 95% interval.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy import stats

from bench.model import compose, registry
from bench.training.environment import Environment
from bench.training.run import Training

ROLLOUTS, WINDOW, BATCH, PASSES, RATE, DISCOUNT, DECAY, EPISODE = 8, 256, 64, 10, 3e-4, 0.99, 0.95, 240


def move(state, action):
    """Return the states ``(B, 4)`` of cart and pole after a control step."""
    for _ in range(4):
        x, angle, speed, turn = state.T
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        k = (10 * jnp.tanh(action) + 0.05 * turn**2 * sine) / 1.1
        turn_rate = (9.81 * sine - cosine * k) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
        speed, turn = speed + (k - 0.05 * turn_rate * cosine / 1.1) / 240, turn + turn_rate / 240
        state = jnp.stack([x + speed / 240, angle + turn / 240, speed, turn], 1)
    return state


def reward(s):
    return -(
        ((s[:, 1] + jnp.pi) % (2 * jnp.pi) - jnp.pi) ** 2
        + 0.1 * s[:, 3] ** 2
        + 0.05 * s[:, 0] ** 2
        + 0.1 * s[:, 2] ** 2
    )


def observe(s):
    return jnp.stack([s[:, 0], s[:, 2], jnp.sin(s[:, 1]), jnp.cos(s[:, 1]), s[:, 3]], 1)


def reset(key, count):
    scale = jnp.array([jnp.pi, jnp.pi, 0.5, 0.5])
    return jnp.array([0, -jnp.pi, 0, 0]) + (jax.random.uniform(key, (count, 4)) - 0.5) * scale


def perceptron(key, last):
    draw = jax.nn.initializers.orthogonal
    sizes = zip(jax.random.split(key, 3), (5, 64, 64), (64, 64, 1), (2**0.5, 2**0.5, last), strict=True)
    return [(draw(gain)(k, (n, m)), jnp.zeros(m)) for k, n, m, gain in sizes]


def output(layers, x):
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    return (x @ layers[-1][0] + layers[-1][1])[..., 0]


def log_probability(p, x, u):
    return -0.5 * ((u - output(p["actor"], x)) / jnp.exp(p["log_deviation"])) ** 2 - p["log_deviation"]


def merged(known, x):
    """Return mean, variance and count of all vectors so far after further ``x (N, n)``."""
    count, change = known[2] + len(x), x.mean(0) - known[0]
    squares = known[1] * known[2] + x.var(0) * len(x) + change**2 * known[2] * len(x) / count
    return known[0] + change * len(x) / count, squares / count, count


def scaled(known, x):
    return jnp.clip((x - known[0]) / jnp.sqrt(known[1] + 1e-8), -10, 10)


def independent(seed, steps, starts):
    """Return the mean return of the independent PPO's policy without noise, from ``starts (B, 4)``."""
    updates = steps // (ROLLOUTS * WINDOW)
    rate = optax.linear_schedule(RATE, 0.0, updates * PASSES * ROLLOUTS * WINDOW // BATCH)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate, eps=1e-5))

    def step(carry, key):
        p, seen, state, age, total = carry
        key_action, key_start = jax.random.split(key)
        x = scaled(seen, observe(state))
        u = output(p["actor"], x) + jnp.exp(p["log_deviation"]) * jax.random.normal(key_action, (ROLLOUTS,))
        reached, age, total = move(state, u), age + 1, DISCOUNT * total + reward(state)
        end = age >= EPISODE
        after = output(p["critic"], scaled(seen, observe(reached)))
        state_next = jnp.where(end[:, None], reset(key_start, ROLLOUTS), reached)
        kept = (observe(state), x, u, reward(state), output(p["critic"], x), after, end, total)
        return (p, seen, state_next, jnp.where(end, 0, age), jnp.where(end, 0.0, total)), kept

    def loss(p, x, u, old, better, target):
        better, ratio = (better - better.mean()) / (better.std() + 1e-8), jnp.exp(log_probability(p, x, u) - old)
        gained = jnp.minimum(ratio * better, jnp.clip(ratio, 0.8, 1.2) * better).mean()
        return -gained + 0.5 * ((output(p["critic"], x) - target) ** 2).mean()

    @jax.jit
    def update(carry, key):
        p, memory, seen, returns, *episodes = carry
        key_window, key_order = jax.random.split(key)
        (_, _, *episodes), (o, x, u, r, before, after, end, total) = jax.lax.scan(
            step, (p, seen, *episodes), jax.random.split(key_window, WINDOW)
        )
        returns = merged(returns, total.reshape(-1, 1))
        wrong = r / jnp.sqrt(returns[1] + 1e-8) + DISCOUNT * after - before
        back = lambda later, at: (at[0] + DISCOUNT * DECAY * jnp.where(at[1], 0, later),) * 2  # noqa: E731
        better = jax.lax.scan(back, jnp.zeros(ROLLOUTS), (wrong, end), reverse=True)[1]
        data = (x.reshape(-1, 5), *(y.reshape(-1) for y in (u, log_probability(p, x, u), better, better + before)))

        def descend(carry, rows):
            p, memory = carry
            change, memory = optimizer.update(jax.grad(loss)(p, *(part[rows] for part in data)), memory)
            return (optax.apply_updates(p, change), memory), None

        orders = [jax.random.permutation(k, ROLLOUTS * WINDOW) for k in jax.random.split(key_order, PASSES)]
        (p, memory), _ = jax.lax.scan(descend, (p, memory), jnp.concatenate(orders).reshape(-1, BATCH))
        return p, memory, merged(seen, o.reshape(-1, 5)), returns, *episodes

    key, *keys = jax.random.split(jax.random.key(seed), 4)
    p = {"actor": perceptron(keys[0], 0.01), "critic": perceptron(keys[1], 1.0), "log_deviation": jnp.array(0.0)}
    unknown = [(jnp.zeros(n), jnp.ones(n), 1e-4) for n in (5, 1)]
    carry = (p, optimizer.init(p), *unknown, reset(keys[2], ROLLOUTS), jnp.zeros(ROLLOUTS, int), jnp.zeros(ROLLOUTS))
    for k in jax.random.split(key, updates):
        carry = update(carry, k)
    p, _, seen, *_ = carry

    def act(state, _):
        return move(state, output(p["actor"], scaled(seen, observe(state)))), reward(state)

    return float(jax.lax.scan(act, starts, None, length=EPISODE)[1].sum(0).mean())


def ours(seed, steps, numbers):
    """Return the same of the package's trainer, from starts by standard normal ``numbers``."""
    parts = registry.make("scenes", "cartpole_swing"), None, registry.make("integrators", "semi_implicit_euler")
    env = Environment(compose(*parts), registry.make("backends", "jax").ops(), "float32")
    run = Training(env, registry.make("trainers", "ppo", {"steps": steps}))
    state = run.start(seed)
    for _ in range(run.trainer.updates(env)):
        state, _ = run.update(state)
    return run.returns(state, numbers).mean()


def main(seeds=5, steps=1_024_000):
    uniform = np.random.default_rng(0).uniform(size=(256, 4))
    scale = np.array([np.pi, np.pi, 0.5, 0.5])
    starts = np.asarray(np.array([0, -np.pi, 0, 0]) + (uniform - 0.5) * scale, "float32")
    numbers = np.zeros((8, 256))
    numbers[:4] = np.sqrt(-2 * np.log(uniform)).T  # of which the scene makes the same uniform numbers
    own = [ours(seed, steps, numbers) for seed in range(seeds)]
    with jax.enable_x64(False):
        results = np.array([own, [independent(seed, steps, starts) for seed in range(seeds)]])
    for name, values in zip(("ppo", "independent"), results, strict=True):
        print(f"{name}: {', '.join(f'{value:.0f}' for value in values)}; mean {values.mean():.0f}", flush=True)
    low, high = stats.ttest_ind(*results, equal_var=False).confidence_interval()
    print(f"difference: {np.subtract(*results.mean(1)):.0f} [{low:.0f}, {high:.0f}]")


if __name__ == "__main__":
    main(*(int(value) for value in sys.argv[1:]))
