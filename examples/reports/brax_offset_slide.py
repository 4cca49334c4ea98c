"""Brax 0.14.2: the axis of a slide does not turn with its body.

``transform_com`` of ``brax/generalized/dynamics.py`` turns the angular part of a joint's axis into the world's frame, and not the linear
part. Slides of the world are right. For a slide on a hinge (case ``offset_slide``) the mass matrix couples both by -0.0346 instead of 0.0172,
and gravity pulls along the slide with -1.128 N instead of 0.425 N.
"""

import mujoco
from brax.generalized import pipeline
from brax.io import mjcf

from bench.engines import conformance

(case,) = conformance.cases("offset_slide")
model = mujoco.MjModel.from_xml_path(str(case.model))
data = mujoco.MjData(model)
data.qpos, data.qvel = case.qpos, case.qvel
mujoco.mj_forward(model, data)
print(data.M, pipeline.init(mjcf.load_model(model), case.qpos, case.qvel).mass_mx)
