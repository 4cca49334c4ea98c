"""Runs in the Python of an engine's environment: answers calls of the engine's model over pipes. Requires only NumPy.

A message is a dictionary and a list of arrays. An engine's file defines a class ``Model``, built from the
description of a program, with

- ``step(x, u)``: the states ``(n, B)`` after one step from states x and controls ``u (m, B)``;
- ``jacobians(x, u)``: its derivatives ``(n, n, B)`` by x and ``(n, m, B)`` by u, or ``pull(x, u, slope)``: the derivatives
  ``(n, B)`` by x and ``(m, B)`` by u of the sum of ``slope * step(x, u)``, which repeats the step under a tape of its own;
  one is made from the other; neither if the engine has no derivatives;
- ``takes_forces``, optional: whether u are the generalised forces ``(n_q, B)`` of motors, springs and dampers, in place of
  the controls;
- ``widths``, optional: the batch sizes B that it can compute, otherwise all;
- ``device``, optional: the device that it computes on;
- ``settings``, optional: a dictionary of the engine's settings that can change its last digits, such as its determinism.

The file may import its libraries, and other files of its folder.
"""

import contextlib
import importlib.util
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

KEPT = 4
"""Number of models that a server stores."""
VARIABLES = ("OMP_NUM_THREADS", "XLA_FLAGS", "JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES")
"""Environment variables that can change an engine's last digits."""


class Controlled:
    """An engine's model with controls u for inputs: its forces, where it takes these, are constant + by_state x + by_control u."""

    def __init__(self, model: Any, forces: dict[str, Any]) -> None:
        self._model = model
        self.device, self.settings = str(getattr(model, "device", "cpu")), _settings(model)
        self._forces = [np.array(forces[name], dtype=np.float64) for name in ("constant", "by_state", "by_control")]
        self._takes_forces = getattr(model, "takes_forces", False)

    def call(self, name: str, x: np.ndarray, u: np.ndarray) -> tuple[list[np.ndarray], int]:
        """Return the arrays that a call results in, and the width of its batches."""
        function: Callable[[np.ndarray, np.ndarray], list[np.ndarray]] = getattr(self, name)
        n_columns = x.shape[-1]
        widths = sorted(getattr(self._model, "widths", None) or [n_columns])
        width = next((width for width in widths if width >= n_columns), widths[-1])
        blocks = []
        for start in range(0, n_columns, width):
            columns = np.minimum(np.arange(start, start + width), n_columns - 1)
            part = [array[..., columns] for array in (x, u)]
            valid = np.all([np.isfinite(array).reshape(-1, width).all(axis=0) for array in part], axis=0)
            # engines raise errors or hang where numbers are not finite
            results = function(*(np.ascontiguousarray(np.where(valid, array, 0.0)) for array in part))
            kept = [np.where(valid, np.asarray(result, dtype=np.float64), np.nan) for result in results]
            blocks.append([result[..., : n_columns - start] for result in kept])
        return [np.concatenate(parts, axis=-1) for parts in zip(*blocks, strict=True)], width

    def step(self, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        """Return the states after one step under the controls u."""
        return [np.array(self._model.step(x, self._input(x, u)), dtype=np.float64)]

    def rollout(self, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        """Return the states ``(T + 1, n, B)`` under controls ``(T, m, B)``."""
        path = [x]
        for control in u:
            path += self.step(path[-1], control)
        return [np.stack(path)]

    def jacobians(self, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        """Return the derivatives of a step by the states and by the controls."""
        force = self._input(x, u)
        if hasattr(self._model, "jacobians"):
            a, b = self._model.jacobians(x, force)
        elif hasattr(self._model, "pull"):
            slopes = [np.broadcast_to(row[:, None], x.shape).copy() for row in np.eye(len(x))]
            pulled = [
                [np.array(part, dtype=np.float64) for part in self._model.pull(x, force, slope)] for slope in slopes
            ]
            a, b = map(np.stack, zip(*pulled, strict=True))
        else:
            raise NotImplementedError("this engine has no derivatives")
        if not self._takes_forces:
            return [a, b]
        _, by_state, by_control = self._forces
        return [a + np.einsum("ifb,fj->ijb", b, by_state), np.einsum("ifb,fj->ijb", b, by_control)]

    def _input(self, x: np.ndarray, u: np.ndarray) -> Any:
        constant, by_state, by_control = self._forces
        return constant[:, None] + by_state @ x + by_control @ u if self._takes_forces else u


# ------------------------------------------------------------------------------------------------------ the server


def serve(file: str, requests: Connection) -> None:
    """Answer requests until the connection is closed."""
    models: dict[int, Any] = {}
    first_calls: set[tuple[int, str, int]] = set()
    module: Any = None
    while True:
        header, arrays = requests.recv()
        started, name, key = time.perf_counter(), header["call"], int(header["model"])
        answer: dict[str, Any] = {}
        results: list[np.ndarray] = []
        try:
            if module is None:
                module = _load(file)
            if key not in models:
                models[key] = Controlled(module.Model(header["description"]), header["description"]["forces"])
                while len(models) > KEPT:
                    del models[next(iter(models))]
                models[key].build_s = time.perf_counter() - started
                started = time.perf_counter()
            model = models[key] = models.pop(key)
            results, width = model.call(name, *arrays)
            answer |= {"device": model.device, "settings": model.settings, "build_s": model.build_s}
            answer |= {"width": width, "is_first": (key, name, width) not in first_calls}
            first_calls.add((key, name, width))
        except Exception as error:
            kind = "unsupported" if isinstance(error, NotImplementedError) else "error"
            kind = "unavailable" if isinstance(error, ImportError) else kind
            frames = traceback.extract_tb(error.__traceback__)[-2:]
            places = " < ".join(f"{os.path.basename(f.filename)}:{f.lineno}" for f in reversed(frames))
            answer, results = {"error": f"{type(error).__name__}: {error}", "kind": kind, "places": places}, []
        answer["seconds"] = time.perf_counter() - started
        answer["peak_memory_mb"] = _peak_memory_mb()
        requests.send((answer, results))


def _settings(model: Any) -> dict[str, str]:
    """Return the number of processors, the variables of :data:`VARIABLES` that are set, and the model's own settings."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    given = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    return {"processors": str(count), **given, **{k: str(v) for k, v in getattr(model, "settings", {}).items()}}


def _peak_memory_mb() -> float:
    """Return the largest resident memory of this process [MB]."""
    try:  # getrusage counts the memory of the process that has started this one
        with open("/proc/self/status") as status:
            return int(status.read().partition("VmHWM:")[2].split()[0]) / 2**10
    except (OSError, ValueError, IndexError):
        scale = 2**20 if sys.platform == "darwin" else 2**10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def _load(file: str) -> Any:
    # last, so that a file named after its engine's library does not hide the library
    sys.path.append(os.path.dirname(os.path.abspath(file)))
    spec = importlib.util.spec_from_file_location("bench_engine_model", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _end_with_stdin() -> None:
    """End this process when its input is closed, even during a call."""
    sys.stdin.read()
    os._exit(0)


def main() -> None:
    """Serve the engine's file; the arguments are the file and the descriptor of its connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the run, which ends its engines
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        serve(sys.argv[1], Connection(int(sys.argv[2])))
    os._exit(0)


if __name__ == "__main__":
    main()
