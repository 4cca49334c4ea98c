"""Right gradients of smooth scenes, on long horizons too, are never blamed; the script beside this file does thousands."""

import false_alarms
import pytest

from bench.gradient import FAULTS


@pytest.mark.slow
def test_smooth_scenes_are_not_blamed():
    lines = false_alarms.run(20, only=lambda name: name.endswith(("1000 rk4", "300 semi_implicit_euler", "None")))
    assert not [line for line in lines if line[2] in FAULTS]
    assert len(lines) == 20
    assert len(false_alarms.SCENES) > 5
