"""MuJoCo 4.0.0: accelerations with a sparse Jacobian differ from those with a dense one.

This happens where branches of a body touch each other (issue 3767 of google-deepmind/mujoco). In the case ``sparse_chain`` the cost after 8
steps is 30.268 instead of 30.844, and its derivative by gravity -0.331 instead of -0.416. MuJoCo 3.17.0 is right with both.
"""

import mujoco

from bench.engines import conformance

(case,) = conformance.cases("sparse_chain")
model = mujoco.MjModel.from_xml_path(str(case.model))
for model.opt.jacobian in (mujoco.mjtJacobian.mjJAC_DENSE, mujoco.mjtJacobian.mjJAC_SPARSE):
    data = mujoco.MjData(model)
    data.qpos, data.qvel = case.qpos, case.qvel
    for data.ctrl in case.controls:
        mujoco.mj_step(model, data)
    print(mujoco.__version__, case.cost(data.qpos, data.qvel))
