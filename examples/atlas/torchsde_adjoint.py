"""A double well by `sdeint_adjoint`."""

import torchsde
from torchsde_backprop import cost, theta, truth
from torchsde_backprop import gradient as backprop

__all__ = ["about", "cost", "gradient", "theta", "truth"]
about = {
    "package": "torchsde",
    "python": "torch",
    "requires": "torch==2.13.0 torchsde",
    "examine": "grad=gradient calls=300",
    "derivative": "wrong",
    "how": "own midpoint scheme of the same increments",
    "advice": "`sdeint_adjoint` is off by a share of the step that halves with it: backpropagate through `sdeint`, or take a smaller dt.",
}


def gradient(p):
    """Return the derivative by the adjoint equation."""
    return backprop(p, torchsde.sdeint_adjoint)
