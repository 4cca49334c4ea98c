"""Runs ``bench.watch`` in loops that others wrote: ``python validation/watched_loops.py [brax] [torch]``.

``brax``: the trainer APG of the installed package, whose source gets the lines of ``CHANGED``, on reacher with springs
as joints, at its own horizon; needs ``pip install brax``. It compiles for minutes, and with ``JAX_COMPILATION_CACHE_DIR`` once
for all seeds. ``torch``: Adam over the start of a ball on a damped spring floor. Each runs sound with ten seeds, with the
states or contact forces detached from update 200 on, and with a step that is unstable from update 500 on, each with and
without the log. Prints what the log says, the share of the loop's time that its checks took after the first two, and
whether the last theta is the same to the bit.
"""

import inspect
import sys
import time

import numpy as np
from simulators import fall

import bench

DETACHED, UNSTABLE, UPDATES, HORIZON = 200, 500, 600, 32
"""Updates from which on there is a fault, updates of a run, and steps of one update of APG."""
CHANGED = {
    "  loss_grad = jax.grad(loss, has_aux=True)\n": """\
  loss_grad = jax.grad(loss, has_aux=True)
  at = lambda policy, w: loss(*_unpmap((policy, *w[:2])), jax.random.split(w[2][0])[1])[0]
  watch = new_watch(jax.jit(at))
""",
    "        'grad_norm': optax.global_norm(grad),\n": "        'gradient': grad,\n",
    "    t = time.time()\n": """\
    t = time.time()
    before = training_state.policy_params, training_state.normalizer_params, env_state, key
""",
    "    metrics = jax.tree_util.tree_map(jnp.mean, metrics)\n": """\
    watch(before[0], _unpmap(metrics.pop('gradient')), before[1:])
    metrics = jax.tree_util.tree_map(jnp.mean, metrics)
""",
    "max(num_evals - 1, 1)": "num_updates",
    "    if process_id == 0:\n      # Run evals.\n": "    if False:\n",
    "  pmap.assert_is_replicated(training_state)\n": "",
    "jax.device_put_replicated(\n      training_state, jax.local_devices()[:local_devices_to_use]\n  )": """\
jax.tree.map(lambda x: jnp.asarray(x)[None], training_state)""",
}
"""Lines of APG's source, and by what a user replaces them: one update an epoch, its gradient is returned and checked, and
no evaluation, nor a comparison of copies, which a theta that is not finite fails; the last is a function that is gone from JAX."""


def brax(new_watch, seed, fault):
    """Train by APG and return the policy's parameters."""
    import jax
    import jax.numpy as jnp
    from brax import envs
    from brax.training.agents.apg import train

    class Planted(envs.Wrapper):
        """An environment with a fault from an update on, counted in a state's ``info``."""

        def reset(self, rng):
            state = self.env.reset(rng)
            return state.replace(info=state.info | {"age": jnp.zeros(())})

        def step(self, state, action):
            system, age = self.unwrapped.sys, state.info["age"]
            if fault == "detached":
                held = jax.lax.stop_gradient(state.pipeline_state)
                held = jax.tree.map(
                    lambda *both: jnp.where(age > HORIZON * DETACHED, *both), held, state.pipeline_state
                )
                state = state.replace(pipeline_state=held)
            if fault == "unstable":
                longer = jnp.where(age > HORIZON * UNSTABLE, 10.0, 1.0) * system.opt.timestep
                self.unwrapped.sys = system.tree_replace({"opt.timestep": longer})
            after = self.env.step(state, action)
            self.unwrapped.sys = system
            return after.replace(info=after.info | {"age": age + 1})

    source = inspect.getsource(train)
    for old, new in CHANGED.items():
        assert source.count(old) == 1
        source = source.replace(old, new)
    exec(source, space := {"__name__": "apg", "new_watch": new_watch})
    env = Planted(envs.get_environment("reacher", backend="spring"))
    return jax.tree.leaves(space["train"](env, 100, UPDATES, num_envs=4, learning_rate=1e-3, seed=seed)[1])


def torch(new_watch, seed, fault):
    """Choose a ball's first height and speed by Adam and return them."""
    import torch

    torch.manual_seed(seed)
    theta = torch.nn.Parameter(torch.tensor([0.3, -1.0]).double() + 0.1 * torch.randn(2))
    optimizer = torch.optim.Adam([theta], lr=3e-4)

    def cost(theta):
        cut = torch.detach if fault == "detached" and update >= DETACHED else torch.clone
        return fall(theta, cut, stiffness=1e5 if fault == "unstable" and update >= UNSTABLE else 200.0)

    watch = new_watch(cost)
    for update in range(UPDATES):  # noqa: B007
        optimizer.zero_grad()
        cost(theta).backward()
        watch(theta, theta.grad)
        optimizer.step()
    return [theta.detach()]


LOOPS = {"brax": brax, "torch": torch}


def report(name, seed, fault):
    """Run a loop with the log and without, and print a line."""
    logs, calls = [], []

    def new_watch(cost):
        logs.append(bench.watch(cost))
        return lambda *given: calls.append((logs[0](*given), time.perf_counter())[1])

    both = LOOPS[name](new_watch, seed, fault), LOOPS[name](lambda cost: lambda *given: None, seed, fault)
    _, second, *others = (row["seconds"] for row in logs[0].rows)
    share = sum(others) / (calls[-1] - calls[0] - second)
    is_same = all(np.array_equal(*pair, equal_nan=True) for pair in zip(*both, strict=True))
    print(f"{name} {fault or 'sound'} {seed}: {logs[0]}; {share:.1%} of the time, same theta: {is_same}")


if __name__ == "__main__":
    for name in sys.argv[1:] or LOOPS:
        for seed, fault in [(0, "detached"), (0, "unstable"), *enumerate([""] * 10)]:
            report(name, seed, fault)
