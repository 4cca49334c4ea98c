"""Right gradients of smooth scenes, on long horizons too, are never blamed; the script beside this file does thousands."""

import pytest
from false_alarms import SCENES, run


@pytest.mark.slow
def test_smooth_scenes_are_not_blamed():
    verdicts, blamed, _ = run(20, only=lambda name: name.endswith(("1000 rk4", "300 semi_implicit_euler", "None")))
    assert not blamed
    assert sum(verdicts.values()) == 20
    assert len(SCENES) > 5
