"""A ball that hits the floor, by `mjd_transitionFD` of each step."""

import mujoco
import numpy as np

about = {
    "package": "mujoco",
    "python": "bench",
    "requires": "mujoco",
    "examine": "grad=gradient calls=1500",
    "derivative": "right",
    "jumps": "jumps",
    "how": "documented contact model",
    "advice": "Contact starts with the force of its damper, so that costs jump where a body lands a step later; gradients are right between.",
}
XML = """<mujoco><worldbody><geom type="plane" size="5 5 1" condim="1" solimp="0.9 0.9 0.001"/>
<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1" condim="1" solimp="0.9 0.9 0.001"/></body></worldbody></mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
theta = np.array([0.05, -1.0])  # gap [m], speed [m/s]


def gradient(p, steps=50):
    """Return the derivative as a product of the steps' matrices."""
    data.qpos[:], data.qvel[:], product = p[0], p[1], np.eye(2)
    for _ in range(steps):
        step = np.empty((2, 2))
        mujoco.mjd_transitionFD(model, data, 1e-6, True, step, None, None, None)
        mujoco.mj_step(model, data)
        product = step @ product
    return product[0]


def cost(p):
    """Return the height after 0.1 s."""
    data.qpos[:], data.qvel[:] = p
    mujoco.mj_step(model, data, 50)
    return float(data.qpos[0])


def truth():
    """Return the derivative: a spring and damper by `solref`, and a tenth of gravity, in touch."""
    x, v = (theta + 1e-30j * np.eye(2)).T
    for _ in range(50):
        pushed = -0.981 + 0.9 * (-2 / 0.018 * v - 0.9 * x / 0.018**2)
        v = v + 0.002 * np.where((x.real < 0) & (pushed.real > -9.81), pushed, -9.81)
        x = x + 0.002 * v
    return x.imag / 1e-30
