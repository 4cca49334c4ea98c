"""What every test stands on."""

import pytest


@pytest.fixture(autouse=True)
def compile_cache(monkeypatch):
    """A command run in this process names a folder of compiled programs; the next test does not see it."""
    monkeypatch.setenv("BENCH_COMPILE_CACHE", "")
