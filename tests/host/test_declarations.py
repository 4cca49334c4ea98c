"""Parameters that a class seems to set, and does not: refused with the fix."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from bench.plugins.scenes.quadratic import Quadratic

from bench.errors import UserError
from bench.host.parameters import parameters
from bench.model import FunctionScene, param


def test_unannotated_override_of_a_parameter_is_refused_with_the_fix():
    """The scene would have run with noise on its parameters."""
    with pytest.raises(TypeError, match=r"without an annotation.*default 'parameter'.*write `noise: str = 'action'`"):

        @dataclass(frozen=True)
        class Pushed(Quadratic):
            noise = "action"


def test_annotated_override_and_class_variables_are_accepted():
    @dataclass(frozen=True)
    class Wide(Quadratic):
        name = "wide"
        neglected_effects = "all"
        continuous: ClassVar[bool] = False
        sigma: float = param(2.0, "wide noise", positive=True)

    assert parameters(Wide)["sigma"].default == Wide().sigma == 2.0


@pytest.mark.parametrize("use", [parameters, lambda plugin: plugin()], ids=["listed", "built"])
def test_plugin_without_dataclass_is_refused_with_the_fix(use):
    """Its parameter vanished: "unknown parameter 'gravity' (allowed: dt)"."""

    class Falling(FunctionScene):
        gravity: float = param(9.81, "gravity", "m/s^2")

        def theta0(self):
            return np.zeros(1)

        def cost(self, xp, x):
            return x[0]

    with pytest.raises(UserError, match=r"Falling declares parameters \(gravity\).*@dataclass\(frozen=True\) above"):
        use(Falling)
    with pytest.raises(UserError, match="Falling declares"):
        use(dataclass(frozen=True)(type("Lower", (Falling,), {})))
