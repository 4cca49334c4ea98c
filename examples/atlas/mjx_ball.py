"""A ball that hits the floor, by JAX with one solver iteration."""

import jax
import numpy as np
from mujoco import MjModel, mjx
from mujoco_ball import truth

__all__ = ["about", "cost", "theta", "truth"]
jax.config.update("jax_enable_x64", True)
about = {
    "package": "mujoco-mjx",
    "python": "bench",
    "requires": "mujoco-mjx mujoco",
    "examine": "grad=jax calls=900",
    "derivative": "right",
    "jumps": "jumps",
    "how": "documented contact model",
}
XML = """<mujoco><option iterations="1" ls_iterations="4"/><worldbody>
<geom type="plane" size="5 5 1" condim="1" solimp="0.9 0.9 0.001"/>
<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1" condim="1" solimp="0.9 0.9 0.001"/></body>
</worldbody></mujoco>"""
model = mjx.put_model(MjModel.from_xml_string(XML))
theta = np.array([0.05, -1.0])  # gap [m], speed [m/s]


def cost(p):
    """Return the height after 0.1 s."""
    start = mjx.make_data(model).replace(qpos=p[:1], qvel=p[1:])
    return jax.lax.scan(lambda d, _: (mjx.step(model, d), None), start, None, 50)[0].qpos[0]
