"""Compiled JAX functions: each made once in a process, counted, and kept between runs in a folder."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bench.contracts import compilations

_known: dict[tuple[Any, ...], Compiled] = {}
_busy = threading.Lock()


@dataclass(frozen=True)
class Compiled:
    """An executable, and the seconds of its tracing, lowering and compiling; ``loaded`` from the folder for the last."""

    name: str
    call: Callable[..., Any]
    seconds: tuple[float, float, float]
    loaded: bool


def compiled(key: tuple[Any, ...], function: Callable[..., Any], arguments: tuple[Any, ...], fresh: bool) -> Compiled:
    """The executable of ``function`` for arguments of such shapes, under a key that tells programs and shapes apart.

    With ``fresh`` its seconds are those of a compilation: the folder is not asked, and what came from it is made again.
    """
    with _busy:
        found = _known.get(key)
        if found is None or (fresh and found.loaded):
            name = found.name if found else hashlib.sha256(repr(key).encode()).hexdigest()[:16]
            found = _known[key] = _compile(name, function, arguments, None if fresh else compilations.folder)
        compilations.shapes.add(found.name)
        return found


def _compile(name: str, function: Callable[..., Any], arguments: tuple[Any, ...], folder: str | None) -> Compiled:
    """Compile, and count it. What libraries make JAX compile on the way, single operations on constants, is in the seconds alone."""
    import jax

    _use(folder)
    _listen()
    # blocks run beside each other, one thread each
    options: dict[str, str | bool] | None = None
    if jax.default_backend() == "cpu":
        options = {"xla_cpu_multi_thread_eigen": False}
    started = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    after_trace = time.perf_counter()
    lowered = traced.lower()
    after_lowering = time.perf_counter()
    before = _loaded
    call = lowered.compile(options)
    seconds = (after_trace - started, after_lowering - after_trace, time.perf_counter() - after_lowering)
    compilations.made += _loaded == before
    return Compiled(name, call, seconds, loaded=_loaded > before)


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
_loaded = 0
"""Programs that JAX took from the folder."""


def _listen() -> None:
    """Have JAX say what it takes from the folder."""
    global _listening
    if _listening:
        return
    _listening = True
    from jax import monitoring

    def happened(event: str, **facts: Any) -> None:
        global _loaded
        _loaded += event == "/jax/compilation_cache/cache_hits"

    monitoring.register_event_listener(happened)
