"""Compiled kernels. A folder stores each kernel's source under its hash, with Numba's machine code beside it."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.model import Compilations, Executable

from .functions import FAST, SLOW

_known: dict[str, Executable] = {}
_busy = threading.Lock()


def compiled(text: str, dtype: str, fresh: bool, count: Compilations) -> Executable:
    """Return the kernel of the source ``text``, compiled once per process; for ``fresh`` see :meth:`Compilations.obtain`."""
    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    # one at a time: Numba's compiler has its own lock
    with _busy:
        return count.obtain(
            _known, name, fresh, lambda folder: _compile(name, text, dtype, folder and folder / "fused")
        )


def exact(text: str) -> str:
    """Return the source with the C library's sine and cosine, for angles beyond the range of the fast functions."""
    return text.replace(FAST, SLOW)


def _compile(name: str, text: str, dtype: str, folder: Path | None) -> Executable:
    from numba import types

    started = time.perf_counter()
    module = _module(name, text, folder)
    kernel = module.kernel
    size = types.int64
    vector, whole = types.Array(getattr(types, dtype), 1, "C"), types.Array(size, 1, "C")
    column = (vector, size, size)
    kernel.compile((vector, vector, whole, size, *column, *column, vector, size, vector, size, size, size, size))
    loaded = folder is not None and bool(kernel.stats.cache_hits)
    return Executable(name, kernel, (time.perf_counter() - started,), loaded)


def _module(name: str, text: str, folder: Path | None) -> ModuleType:
    """Return the module of a source: from a file, for which Numba stores machine code, or from memory if no folder."""
    full = f"_bench_fused_{name}"
    if folder is None:
        module = ModuleType(full)
        exec(compile(text, f"<{full}>", "exec"), vars(module))
        return module
    path = folder / f"{name}.py"
    # never rewrite an existing file: Numba discards machine code older than its source
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        handle, draft = tempfile.mkstemp(dir=folder, suffix=".draft")
        with os.fdopen(handle, "w") as file:
            file.write(text.replace("cache=False", "cache=True"))
        os.replace(draft, path)
    spec: Any = importlib.util.spec_from_file_location(full, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[full] = module
    spec.loader.exec_module(module)
    return module
