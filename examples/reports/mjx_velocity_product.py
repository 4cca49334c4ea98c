"""MJX 3.17.0: connect and weld constraints lack the velocity product J-dot v.

MuJoCo's C engine subtracts J-dot v from their reference acceleration, MJX does not. For a four-bar loop at 6 rad/s the C engine has
(32.4, 0, -22.3) and MJX (-0.006, 0, -0.043), so values and derivatives of moving loops and welds differ.
"""

import mujoco
from mujoco import mjx
from mujoco.mjx._src import forward

model = mujoco.MjModel.from_xml_path("bench/engines/conformance/cases/connect_fast.xml")
data = mujoco.MjData(model)
data.qpos, data.qvel = [-0.5, 1.0413, -1.8394], [6, -14.47, 7.51]
mujoco.mj_forward(model, data)
print(data.efc_aref, forward.fwd_position(mjx.put_model(model), mjx.put_data(model, data))._impl.efc_aref)
