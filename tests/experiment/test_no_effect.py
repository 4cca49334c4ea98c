"""A parameter without effect in a combination is no axis and no theta, and a row that sets it says so."""

import pytest
from helpers import loaded

from bench import run
from bench.errors import UserError

IGNORED = [
    ("penalty", "bouncing_ball", "restitution"),
    ("impulse", "friction_block", "friction"),
    ("complementarity", "friction_block", "friction"),
    ("surrogate_backward", "hopper_run", "slip_speed"),
    ("complementarity", "pushing", "restitution"),
    ("", "double_pendulum", "mass"),
]


def words(law, scene):
    return [f"scenes=[{scene}]", *([f"contacts=[{law}]"] if law else []), "backends=[implicit]", "estimators=[fobg]"]


@pytest.mark.parametrize(("law", "scene", "name"), IGNORED)
def test_parameter_without_effect_is_no_axis_and_no_theta(law, scene, name):
    _, found = loaded(*words(law, scene), f"sweep.{scene}.{name}=[0.1,0.2]")
    said = f"{name} has no effect in scene {scene}"
    for cell in found:
        status, reason = cell.refusal()
        assert status == "unsupported"
        assert reason.startswith(said)
    with pytest.raises(UserError, match=f"theta names '{name}': {said}"):
        loaded(*words(law, scene), f"theta=[{name}]")


def test_parameter_with_an_effect_is_both():
    for given in ("sweep.bouncing_ball.restitution=[0.1,0.2]", "theta=[restitution]"):
        _, found = loaded("scenes=[bouncing_ball]", "contacts=[impulse]", "backends=[jax]", "estimators=[fobg]", given)
        assert [cell.refusal() for cell in found] == [None] * len(found)


def test_row_that_sets_it_says_so(tmp_path):
    given = ["scenes=[bouncing_ball[horizon=4]]", "backends=[numpy]", "estimators=[fobg]", "contacts=[penalty,impulse]"]
    small = ["samples=4", "repeats=2", "workers=0", "formats=[]", f"results_dir={tmp_path}", "name=one"]
    rows = run([*given, *small, "scene.bouncing_ball.restitution=0.5"]).set_index("contact")
    assert "restitution has no effect in scene bouncing_ball under contact law penalty" in rows.loc["penalty", "reason"]
    assert "no effect" not in rows.loc["impulse", "reason"]
