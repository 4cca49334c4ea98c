"""A cube tossed in three dimensions, in MuJoCo and MJX: a free joint, so nq = 7 and nv = 6, landing on its corners."""

import sys

import jax
import numpy as np

import bench

jax.config.update("jax_enable_x64", True)
CUBE = """
<mujoco>
  <option timestep="0.005" iterations="4" ls_iterations="8"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.4">
      <freejoint/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
theta = np.array([1.0, 0.2, 0.5, 1.0, 2.0, -1.0])  # first velocity [m/s] and spin [rad/s]


def start(model, data, theta):
    """Throw it with the velocity theta."""
    return {"qvel": theta}


def cost(model, data):
    """Squared distance to a target on the floor."""
    return (data.qpos[0] - 0.6) ** 2 + data.qpos[1] ** 2


if __name__ == "__main__":
    for engine in sys.argv[1:] or ["mujoco", "mjx"]:
        toss = bench.Mjcf(CUBE, start, cost, steps=120, engine=engine)
        print(bench.examine(toss, theta, grad=toss.gradient, sigma=[0.01, 0.1], budget="180s"), end="\n\n")
