"""Differences of single steps in MuJoCo: too wide ones straddle the switches of a contact that sticks."""

import pytest

pytest.importorskip("mujoco")
import straddled


@pytest.mark.slow
def test_finer_differences_of_steps_chain_to_the_derivative_of_the_rollout():
    assert straddled.straddled(1e-6, 8).sum() > 0
    assert straddled.straddled(1e-7, 8).sum() == 0
    assert straddled.wrong(1e-6, 8).sum() > 0
    assert straddled.wrong(1e-7, 8).sum() == 0
