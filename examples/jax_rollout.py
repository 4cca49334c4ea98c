"""A JAX rollout of two bodies that push each other, with the contact force cut out of the gradient by mistake."""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)
theta = {"speed": jnp.array([1.0, 0.1]), "stiffness": jnp.array(100.0)}


def rollout(theta, cut):
    """Return the squared distance of the second body to 1 m; `cut` is between the contact force and its use."""

    def step(carry, _):
        q, v = carry
        force = cut(theta["stiffness"] * jax.nn.relu(q[0] - q[1] + 0.1))
        v = v + 0.01 * jnp.stack([-force, force])
        return (q + 0.01 * v, v), None

    (q, v), _ = jax.lax.scan(step, (jnp.array([0.0, 0.3]), theta["speed"]), None, length=150)
    return (q[1] - 1.0) ** 2 + 0.1 * v @ v


def cost(theta):
    """The right one."""
    return rollout(theta, lambda force: force)


def detached(theta):
    """The same with `stop_gradient` on the contact force."""
    return rollout(theta, jax.lax.stop_gradient)


if __name__ == "__main__":
    import bench

    for function in (cost, detached):
        print(bench.examine(function, theta, grad="jax", sigma=[0.003, 0.05], budget="60s"), end="\n\n")
