"""bench_self on a machine that lacks a library: a line that says so, and no failure."""

import dataclasses

import pytest
import yaml
from speed import rollouts

from bench.experiment.config import config_dir
from bench.model import registry


@pytest.mark.slow
def test_an_absent_library_is_a_line_with_the_command_that_installs_it(monkeypatch):
    settings = yaml.safe_load((config_dir() / "bench_self.yaml").read_text())
    settings["subjects"] = [one for one in settings["subjects"] if one["backend"] == "fused"]
    entry = dataclasses.replace(registry.find("backends", "fused"), reason="not installed: numba; pip install numba")
    monkeypatch.setattr(registry, "find", lambda kind, name: entry)
    line, device = rollouts.measure_backends(settings, True)
    assert line.note == "unavailable: not installed: numba; pip install numba"
    assert device.note == "no device: every row is of the processor"
