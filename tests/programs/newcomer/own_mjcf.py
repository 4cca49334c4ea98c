import bench

XML = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 .5"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


def start(model, data, theta):
    return {"qvel": [theta[0], 0, theta[1], 0, 0, 0]}


def cost(model, data):
    return (data.qpos[0] - 1.0) ** 2


cube = bench.Mjcf(XML, start, cost, steps=150)
print(bench.examine(cube, [1.0, 2.0]))
