"""A pendulum for 50 steps, as `gymnax.make` returns it."""

from gymnax_pendulum import cost as whole
from gymnax_pendulum import plain, theta, truth

__all__ = ["about", "cost", "theta", "truth"]
about = {
    "package": "gymnax",
    "python": "jax",
    "requires": "gymnax",
    "examine": "grad=jax calls=2000",
    "derivative": "wrong",
    "how": "the published equations",
    "advice": "By default each step detaches its state, so that a gradient through a rollout has the direct effect on rewards only. "
    "`env.with_transition_gradients()` makes it whole.",
}


def cost(p):
    """Return minus the sum of rewards."""
    return whole(p, plain)
