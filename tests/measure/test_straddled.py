"""Differences of single steps in MuJoCo: those that straddle the switches of a contact that sticks are taken again."""

import pytest

pytest.importorskip("mujoco")
import straddled


@pytest.mark.slow
def test_differences_of_steps_chain_to_the_derivative_of_the_rollout():
    assert straddled.straddled(1e-6, 8).sum() == 0
    assert straddled.wrong(1e-6, 8).sum() == 0
