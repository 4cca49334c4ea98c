"""Names changes of the process's settings that decide numbers: precision, error states, threads, generators and default types.

Nothing is undone. A worker whose settings have changed ends, and a worker that has run code from outside the package runs no
other code, so a function that a plugin replaces reaches only cells with the same plugin.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController, threadpool_limits

JAX = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion", "jax_default_prng_impl",
    "jax_disable_jit", "jax_debug_nans",
)  # fmt: skip
"""The settings of JAX that are compared."""
X64 = "JAX_ENABLE_X64"
"""Environment variable with which JAX computes in float64 from its import on."""


def _numpy_generator() -> tuple[Any, ...]:
    name, numbers, *rest = np.random.get_state()  # noqa: NPY002, the generator that a plugin may have used
    return (name, np.asarray(numbers).tobytes(), *rest)


DRAWN = "the seed of numpy.random"
SETTINGS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "the seed of random": ("random", lambda _: random.getstate()),
    DRAWN: ("numpy", lambda _: _numpy_generator()),
    "the seed of torch": ("torch", lambda torch: torch.random.get_rng_state().numpy().tobytes()),
    "NumPy's error state": ("numpy", lambda numpy: numpy.geterr()),
    "SciPy's error state": ("scipy.special", lambda special: special.geterr()),
    "JAX's configuration": ("jax", lambda jax: {name: jax.config.values.get(name) for name in JAX}),
    "torch's default type": ("torch", lambda torch: torch.get_default_dtype()),
    "torch's threads": ("torch", lambda torch: torch.get_num_threads()),
    "torch's gradients": ("torch", lambda torch: torch.is_grad_enabled()),
}
"""The settings that are compared: their library, and how they are read."""
THREADS = "the threads of linear algebra"


class ProcessState:
    """The settings of this process at one moment, to be compared with later ones.

    JAX computes in float64 from then on, whichever cell imports it. With ``single_thread``, libraries of linear algebra use
    one thread until :meth:`close`: the number of threads changes the order of sums.
    """

    def __init__(self, single_thread: bool = False) -> None:
        self._single_thread = single_thread
        self._before: dict[str, Any] = {}
        self._threads: dict[str, tuple[Any, int]] = {}
        """The libraries of linear algebra by file, each with its number of threads."""
        self._ends = ExitStack()
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(X64.lower(), True)
        else:
            given, os.environ[X64] = os.environ.get(X64), "1"
            self._ends.callback(lambda: os.environ.pop(X64) if given is None else os.environ.update({X64: given}))
        self.follow()

    def close(self) -> None:
        """Restore the numbers of threads."""
        self._ends.close()

    def follow(self) -> None:
        """Add the settings of the libraries that have been imported since: what their imports change is their own."""
        new = [name for name, part in SETTINGS.items() if name not in self._before and part[0] in sys.modules]
        if not new:
            return
        if self._single_thread:
            self._ends.enter_context(threadpool_limits(1))
        for library in ThreadpoolController().lib_controllers:
            self._threads.setdefault(library.filepath, (library, library.num_threads))
        self._before |= {name: _read(name) for name in new}
        if "JAX's configuration" in new:
            self._before["JAX's configuration"]["jax_enable_x64"] = True
            self._before[DRAWN] = _numpy_generator()  # the import of JAX draws from it

    def changes(self) -> list[str]:
        """Return what has changed, as phrases such as ``NumPy's error state (divide)``."""
        self.follow()
        phrases = []
        for name, before in self._before.items():
            after = _read(name)
            if after != before:
                are_tables = isinstance(before, dict) and isinstance(after, dict)
                parts = sorted(key for key in before if before[key] != after[key]) if are_tables else []
                phrases.append(name + (f" ({', '.join(parts)})" if parts else ""))
        if any(library.get_num_threads() != count for library, count in self._threads.values()):
            phrases.append(THREADS)
        return phrases


def _read(name: str) -> Any:
    """Return a setting, or an error's text if it cannot be read, since a plugin has replaced its library."""
    library, read = SETTINGS[name]
    try:
        return read(sys.modules[library])
    except Exception as error:
        return repr(error)


def reduced_precision() -> bool:
    """Return whether JAX computes in float32, whatever type a plugin asks for."""
    return not getattr(getattr(sys.modules.get("jax"), "config", None), X64.lower(), True)
