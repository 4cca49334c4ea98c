"""The step-ellipsoidal function of BBOB, differentiated by JAX."""

import evosax.problems
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
about = {
    "package": "evosax",
    "python": "jax",
    "requires": "evosax",
    "examine": "grad=jax sigma=0.1 calls=3000",
    "derivative": "right",
    "use": "NOT usable",
    "jumps": "jumps",
    "how": "definition",
    "advice": "The step-ellipsoidal function has a derivative of 0 at almost every point, so that only methods from costs see its slope.",
}
theta = np.array([1.23, -0.71, 0.55, 1.37])
step = evosax.problems.BBOBProblem("step_ellipsoidal", 4, x_opt=jnp.zeros(4), f_opt=0.0, sample_rotations=False)
STATE = step.init(jax.random.key(0))


def cost(x):
    """Return the function's value."""
    return step.eval(jax.random.key(0), x[None], STATE)[0][0]


def truth():
    """Return the derivative."""
    return np.zeros(4)
