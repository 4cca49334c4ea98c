import jax
import jax.numpy as jnp

import bench


def cost(theta):  # a ball on a soft floor
    def step(state, _):
        q, v = state
        v = v + 0.002 * (-9.81 + theta["stiffness"] * jax.nn.relu(-q))
        return (q + 0.002 * v, v), None

    (q, _), _ = jax.lax.scan(step, (theta["height"], jnp.array(0.0)), None, length=400)
    return (q - 0.3) ** 2


print(bench.examine(cost, {"height": 0.5, "stiffness": 2000.0}, grad="jax"))
