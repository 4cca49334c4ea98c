"""Is a detached damper of a fixed-step ball named, whatever its size and whatever sigma? python detached_damper.py"""

import itertools

import jax
import jax.numpy as jnp

import bench

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
for damping, sigma in itertools.product((0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0), ((), (0.01,), (0.01, 0.1))):
    r = bench.examine(ball(damping, True), theta, grad="jax", sigma=list(sigma), budget=60)
    head = str(r).split(". ", 1)
    print(
        f"damping {damping:<5} sigma {sigma!s:<12} {head[0]:<24} {str(head[1]).split(':')[0]:<14} {str(head[1]).split('(')[1].split(':')[0] if '(' in head[1] else ''}",
        flush=True,
    )
