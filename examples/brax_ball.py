"""Brax, a ball dropped on a floor by its three engines: generalized, positional and spring."""

import importlib
import sys

import jax
from brax.io import mjcf

jax.config.update("jax_enable_x64", True)
theta = [0.5, -1.0]  # first height of the centre [m] and speed [m/s]
BALL = """
<mujoco>
  <option timestep="0.004"/>
  <custom><numeric name="elasticity" data="0.8"/></custom>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


def rollout(engine):
    """Return the cost of an engine: squared distance of the height after 0.4 s to 0.3 m."""
    pipeline, system = importlib.import_module(f"brax.{engine}.pipeline"), mjcf.loads(BALL)

    def cost(theta):
        first = pipeline.init(system, theta[:1], theta[1:])
        last, _ = jax.lax.scan(lambda s, _: (pipeline.step(system, s, jax.numpy.zeros(0)), None), first, length=100)
        return (last.q[0] - 0.3) ** 2

    return cost


if __name__ == "__main__":
    import bench

    for engine in sys.argv[1:] or ["generalized", "positional", "spring"]:
        settings = {"grad": "jax", "sigma": [0.003, 0.05], "budget": "560s", "name": f"Brax {engine}"}
        print(bench.examine(rollout(engine), theta, **settings), end="\n\n")
