"""Right gradients of smooth scenes, on long horizons too, are never blamed; the script beside this file does thousands."""

import false_alarms
import pytest

from bench.measure.gradcheck import FAULTS


@pytest.mark.slow
def test_smooth_scenes_are_not_blamed():
    lines = false_alarms.run(20, only=lambda name: name.endswith(("1000 rk4", "300 semi_implicit_euler", "None")))
    assert not [line for line in lines if line[3] in FAULTS]
    assert len(lines) == 20
    assert len(false_alarms.SCENES) > 5


def test_checks_in_the_file_are_not_run_again(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(false_alarms, "SCENES", ("cubic", "quadratic"))
    monkeypatch.setattr(false_alarms, "ELSE", 1)
    file = tmp_path / "checks.csv"
    false_alarms.main(2, 0, file)
    before = file.read_text()
    file.write_text(before + "2,cubic")  # a run that was killed in its line
    false_alarms.main(4, 0, file)
    after = file.read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 4
    assert "4 checks: 0 gradients of right programs blamed" in capsys.readouterr().out
