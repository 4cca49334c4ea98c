"""A box thrown on the ground, soft contacts."""

import jax
import jax.numpy as jnp
import jaxsim.api as js
import numpy as np
from rod.builder.primitives import BoxBuilder

jax.config.update("jax_enable_x64", True)
about = {
    "package": "jaxsim",
    "python": "jax",
    "requires": "jaxsim",
    "examine": "grad=jax sigma=0.05 calls=3000",
    "derivative": "right",
    "use": "NOT usable",
    "jumps": "jumps",
    "how": "differences over two widths",
    "advice": "The place where a thrown box rests jumps by millimetres between neighbouring speeds: gradients are right at each, and their mean is not "
    "the slope of the mean.",
}
theta, SPIN, PLACE = np.array([1.0, 0.2, -0.5]), jnp.array([0.3, 0.2, 0.1]), jnp.array([0, 0, 0.15])
builder = BoxBuilder(x=0.3, y=0.2, z=0.1, mass=1.0, name="box").build_model()
description = builder.add_link().add_inertial().add_visual().add_collision().build()
model = js.model.JaxSimModel.build_from_model_description(description, time_step=1e-3)


def cost(v, steps=300):
    """Return the last position along x."""
    first = {"base_position": PLACE, "base_linear_velocity": v, "base_angular_velocity": SPIN}
    start = js.data.JaxSimModelData.build(model, **first)
    return jax.lax.scan(lambda d, _: (js.model.step(model, d), None), start, None, steps)[0].base_position[0]


def truth(h=1e-5):
    """Return the derivative by five points."""
    at = jnp.array(theta) + h * jnp.concatenate([k * jnp.eye(3) for k in (-2, -1, 1, 2)])
    return np.array([1, -8, 8, -1]) @ np.array(jax.jit(jax.vmap(cost))(at)).reshape(4, 3) / 12 / h
