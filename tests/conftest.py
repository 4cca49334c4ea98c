"""Settings and fixtures of all tests: quick compilation, plugins that are forgotten after each test, and a browser."""

import compileall
import gc
import itertools
import os
import sys
import time
from pathlib import Path

import pytest
from browser import CHROMIUM, MISSING, chromium

from bench.host import trial
from bench.model import registry

QUICK = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_parallel_codegen_split_count=1 --xla_cpu_multi_thread_eigen=false"
)
"""Tests compile hundreds of programs and run each for milliseconds. Without optimisation and fused loops, XLA compiles in a
quarter of the time, and numbers are equal up to rounding. One module per program instead of up to 32, whose threads would
share the cores with other tests, takes 40% off that. Processes that a test starts inherit the setting."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Threads that wait for small products of matrices in other threads take a tenth of the processor time of tests. The processes
of pytest-xdist, and those that a test starts, inherit these variables."""

COMPILED = ("bench", "plugins", "validation")
"""Folders whose bytecode is written before the tests, also where PYTHONDONTWRITEBYTECODE is set: hundreds of processes import
their files, and compiling these takes a third of the start of a process."""


def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        for folder in COMPILED:
            compileall.compile_dir(config.rootpath / folder, quiet=2)
    os.environ["XDG_CACHE_HOME"] = str(config.rootpath / ".pytest_cache" / "home")
    os.environ |= {name: os.environ.get(name, count) for name, count in ONE_THREAD.items()}
    os.environ["XLA_FLAGS"] = f"{QUICK} {os.environ.get('XLA_FLAGS', '')}".strip()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Write the bytecode of test files for later sessions, and exempt what collection imports from garbage collection.

    The bytecode of files that tests edit is never written. A full garbage collection traverses all objects of JAX, torch and
    the tests, and took a tenth of the time of tests. Tests leave little garbage, so that collections are rare.
    """
    chosen, sys.dont_write_bytecode = sys.dont_write_bytecode, False
    gc.disable()
    try:
        return (yield)
    finally:
        sys.dont_write_bytecode = chosen
        gc.enable()
        gc.freeze()
        gc.set_threshold(20_000, 20, 50)


DRAWN = {
    "test_a_filter_takes_cells_from_the_table",
    "test_hostile_names_are_shown_as_they_are_and_do_nothing",
}
"""Tests in Chromium that belong to the fast set; the others, which take a third of its time, are slow."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests that draw pages in Chromium as slow, except those of :data:`DRAWN`."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()) and item.originalname not in DRAWN:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True, scope="session")
def one_width():
    """Pad small batches to one width, so that JAX compiles each function of a program once; padding changes no digit."""
    from bench.plugins.backends.jax import JaxProblem

    JaxProblem.grain = 128


@pytest.fixture(autouse=True)
def untried(monkeypatch):
    """Import plugin files without a trial in a separate process; tests of the trial override this fixture."""
    monkeypatch.setattr(trial, "find_fatal_modules", lambda *_: {})


@pytest.fixture(autouse=True)
def remove_plugin_folders():
    """Remove the plugin folders that a test added, with their plugins, and forget that their code has run."""
    before = registry.folders()
    yield
    registry._environment.clear()
    registry.IMPORTED.clear()
    if tasks := sys.modules.get("bench.run.tasks"):
        tasks.RAN.clear()
    if registry.folders() != before:
        registry._folders[:] = before
        registry.entries.cache_clear()


MOST_MAPPINGS = 30_000
"""Memory mappings of a process from which compiled programs are dropped. Linux allows 65,530, each program has about 20, and
LLVM ends a process that gets no more."""
tests_run = itertools.count(1)


@pytest.fixture(autouse=True)
def drop_compiled_programs():
    """Drop JAX's compiled programs if the process nears the limit of memory mappings.

    That is checked after every tenth test, and after tests of a second or more, which may have compiled much.
    """
    started = time.monotonic()
    yield
    is_due = next(tests_run) % 10 == 0 or time.monotonic() - started > 1.0
    if not is_due or "jax" not in sys.modules:
        return
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPPINGS:
        sys.modules["jax"].clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def browser():
    """Return a page of the installed Chromium, without a network."""
    if CHROMIUM is None:
        pytest.skip(MISSING)
    with chromium() as page:
        yield page
