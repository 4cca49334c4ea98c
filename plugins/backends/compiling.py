"""Compiled JAX functions: each made once in a process, counted, and kept between runs in a folder."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.contracts import compilations

_known: dict[tuple[Any, ...], Compiled] = {}
_busy = threading.Lock()


@dataclass(frozen=True)
class Compiled:
    """An executable, and the seconds of making it; ``loaded`` from the folder rather than compiled."""

    call: Callable[..., Any]
    trace_s: float
    lower_s: float
    compile_s: float
    loaded: bool

    @property
    def seconds(self) -> float:
        """Tracing, lowering and compiling together."""
        return self.trace_s + self.lower_s + self.compile_s


def compiled(key: tuple[Any, ...], function: Callable[..., Any], arguments: tuple[Any, ...], fresh: bool) -> Compiled:
    """The executable of ``function`` for arguments of such shapes, under a key that tells programs and shapes apart.

    With ``fresh`` its seconds are those of a compilation: the folder is not asked, and what came from it is made again.
    """
    with _busy:
        compilations.shapes.add(hashlib.sha256(repr(key).encode()).hexdigest()[:16])
        found = _known.get(key)
        if found is None or (fresh and found.loaded):
            found = _known[key] = _compile(function, arguments, None if fresh else compilations.folder)
        return found


def _compile(function: Callable[..., Any], arguments: tuple[Any, ...], folder: str | None) -> Compiled:
    import jax

    _use(folder)
    _listen()
    before = compilations.made
    clock = [time.perf_counter()]
    # blocks run beside each other, one thread each
    options: dict[str, str | bool] | None = None
    if jax.default_backend() == "cpu":
        options = {"xla_cpu_multi_thread_eigen": False}
    traced = jax.jit(function).trace(*arguments)
    clock.append(time.perf_counter())
    lowered = traced.lower()
    clock.append(time.perf_counter())
    call = lowered.compile(options)
    clock.append(time.perf_counter())
    trace_s, lower_s, compile_s = np.diff(clock)
    return Compiled(call, float(trace_s), float(lower_s), float(compile_s), loaded=compilations.made == before)


def _use(folder: str | None) -> None:
    """Keep what is compiled in a folder and take it from there, or neither."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    if jax.config.jax_compilation_cache_dir != folder:  # type: ignore[attr-defined]
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


_listening = False


def _listen() -> None:
    """Count what XLA compiles in this process, wherever it is asked to, less what it takes from the folder."""
    global _listening
    if _listening:
        return
    _listening = True
    from jax import monitoring

    def duration(event: str, duration_secs: float, **facts: Any) -> None:
        compilations.made += event == "/jax/core/compile/backend_compile_duration"

    def happened(event: str, **facts: Any) -> None:
        compilations.made -= event == "/jax/compilation_cache/cache_hits"

    monitoring.register_event_duration_secs_listener(duration)
    monitoring.register_event_listener(happened)
