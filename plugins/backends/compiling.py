"""Compiles JAX functions, keeps the executables used last, counts the compilations, and stores executables between runs."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from bench.model import Compilations, Executable

KEPT = 256
"""Executables kept per process. Each has 20 to 40 memory mappings, and Linux ends a process that needs more than 65,530."""

XLA_THREADS = "xla_cpu_multi_thread_eigen"
CPU_OPTIONS: dict[str, str | bool] = {XLA_THREADS: False, "xla_cpu_copy_insertion_use_region_analysis": True}
"""XLA's options on the CPU: blocks run in parallel, each on one thread, and loops copy no carries needlessly. The second may be
missing in a version of XLA, and changes no result."""

_known: dict[tuple[Any, ...], Executable] = {}
_busy = threading.Lock()


def compiled(
    key: tuple[Any, ...],
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    fresh: bool,
    count: Compilations,
) -> Executable:
    """Return the executable of ``function`` for the shapes of ``arguments``; ``key`` identifies program and shapes.

    Its seconds are of tracing, lowering and compiling. For ``fresh`` see :meth:`Compilations.obtain`.
    """

    def make(folder: Path | None) -> Executable:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return _compile(name, function, arguments, None if folder is None else str(folder))

    # one at a time, since JAX's cache folder is a global setting
    with _busy:
        executable = count.obtain(_known, key, fresh, make)
        if len(_known) > KEPT:
            del _known[next(iter(_known))]
        return executable


def _compile(name: str, function: Callable[..., Any], arguments: tuple[Any, ...], folder: str | None) -> Executable:
    """Return the executable of a function, with its compile times.

    Libraries may compile single operations on constants meanwhile. Their time is included, but they are not counted.
    """
    import jax

    _use(folder)
    _listen()
    options = CPU_OPTIONS if jax.default_backend() == "cpu" else None
    started = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    after_trace = time.perf_counter()
    lowered = traced.lower()
    after_lowering = time.perf_counter()
    before = _loaded
    try:
        call = lowered.compile(options)
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        call = lowered.compile({XLA_THREADS: False})
    seconds = (after_trace - started, after_lowering - after_trace, time.perf_counter() - after_lowering)
    return Executable(name, call, seconds, loaded=_loaded > before)


def _use(folder: str | None) -> None:
    """Store compiled programs in a folder and load them from it; with None, do neither."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    if jax.config.jax_compilation_cache_dir != folder:  # type: ignore[attr-defined]
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


_loaded = 0
"""Number of programs that JAX has loaded from the folder."""


@cache
def _listen() -> None:
    """Register a listener for programs that JAX loads from the folder, once per process."""
    from jax import monitoring

    def record(event: str, **facts: Any) -> None:
        global _loaded
        _loaded += event == "/jax/compilation_cache/cache_hits"

    monitoring.register_event_listener(record)
