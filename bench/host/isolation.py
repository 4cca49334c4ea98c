"""Settings of the process that decide numbers: float64 of JAX, and one thread of linear algebra.

What a plugin changes in its process reaches no cell without that plugin: a worker that has run code from outside the
package runs no other code.
"""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack

from threadpoolctl import threadpool_limits

X64 = "JAX_ENABLE_X64"
"""Environment variable with which JAX computes in float64 from its import on."""


class ProcessState:
    """The settings of this process until :meth:`close`.

    JAX computes in float64 from then on, whichever cell imports it. With ``single_thread``, libraries of linear algebra use
    one thread: the number of threads changes the order of sums.
    """

    def __init__(self, single_thread: bool = False) -> None:
        self._single_thread = single_thread
        self._limited: set[str] = set()
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
        """Limit the threads of the libraries that have been imported since."""
        new = ({"numpy", "scipy.special", "jax", "torch"} - self._limited) & sys.modules.keys()
        if new and self._single_thread:
            self._ends.enter_context(threadpool_limits(1))
        self._limited |= new


def reduced_precision() -> bool:
    """Return whether JAX computes in float32, whatever type a plugin asks for."""
    return not getattr(getattr(sys.modules.get("jax"), "config", None), X64.lower(), True)
