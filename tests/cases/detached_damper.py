"""Is a detached damper of a fixed-step ball named, whatever its size and whatever sigma?"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)
DT, STEPS, MASS = 2e-3, 400, 0.2


def ball(damping, detach):
    def cost(p):
        def step(s, _):
            x, v = s
            depth = jnp.maximum(-x, 0.0)
            damper = damping * v * (depth > 0)
            damper = jax.lax.stop_gradient(damper) if detach else damper
            v = v + DT * (-9.81 + (p["stiffness"] * depth - damper) / MASS)
            return (x + DT * v, v), x

        (x, _), xs = jax.lax.scan(step, (p["height"], p["speed"]), length=STEPS)
        return (x - 0.3) ** 2 + 0.1 * jnp.mean(xs**2)

    return jax.jit(cost)


theta = {"height": 0.5, "speed": -1.0, "stiffness": 800.0}
