"""JAX-MD 0.2.29: in reverse mode the derivative of a Lennard-Jones energy by sigma or epsilon is NaN.

``sigma / dr`` is differentiated where particles meet themselves or the padding of a list (issue 258 of jax-md/jax-md). The derivative by
sigma is 1.74691, as in forward mode.
"""

import jax
import jax.numpy as jnp
from jax_md import energy, space

places = jnp.array([[1.0, 1.0], [2.1, 1.0], [7.0, 7.0]])
pair = energy.lennard_jones_pair(space.periodic(10.0)[0])
print(jax.grad(lambda s: pair(places, sigma=s))(1.0), jax.jacfwd(lambda s: pair(places, sigma=s))(1.0))
