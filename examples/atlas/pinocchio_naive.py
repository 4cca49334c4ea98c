"""Accelerations of a free body by its pose, without `dIntegrate`."""

from pinocchio_pose import cost, theta, truth
from pinocchio_pose import naive as gradient

__all__ = ["about", "cost", "gradient", "theta", "truth"]
about = {
    "package": "pin",
    "python": "plain",
    "requires": "pin",
    "examine": "grad=gradient calls=6000",
    "derivative": "wrong",
    "how": "the equations of one body",
    "advice": "`computeABADerivatives` are by a tangent step at q. By a step from another pose, multiply by `dIntegrate(..., ARG1)`.",
}
