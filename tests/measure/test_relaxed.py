"""The distance of the central path from its spring, as the script beside this file measures it."""

import importlib.util

import numpy as np
import pytest
from relaxed import mean_gradient


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("optimistix") is None, reason="optimistix is not installed")
def test_central_path_nears_the_spring_as_kappa_falls():
    """On 16 draws, as on the 512 of the script: about 1% off at kappa = 1e-6, and far less at 1e-8."""
    spring = mean_gradient(1e3, 1e-10, 16)
    wide, near = (np.linalg.norm(mean_gradient(1e3, kappa, 16) - spring) for kappa in (1e-6, 1e-8))
    size = np.linalg.norm(spring)
    assert 3e-3 * size < wide < 3e-2 * size
    assert near < 0.2 * wide
