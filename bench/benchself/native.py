"""The native reference: a fused C loop with its own adjoint, made by the system's compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
LANES = 32
"""Batches must be a multiple of this."""


class Unavailable(Exception):
    """Raised when there is no compiler here, or it failed."""


class Parameters(ctypes.Structure):
    """Parameters of the scene and its contact law."""

    _fields_ = [(name, ctypes.c_double) for name in ("dt", "mass", "factor", "speed", "sigma", "stiffness")]


def gradient(scene: Any, stiffness: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the function from ``theta (T,)``, ``w (T, B)`` to df/dtheta ``(T, B)``; raises :class:`Unavailable`."""
    library = _library()
    values = Parameters(scene.dt, scene.mass, scene.velocity_factor, scene.speed, scene.sigma, stiffness)
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    size = ctypes.c_size_t
    library.pushing.argtypes = [ctypes.POINTER(Parameters), size, size, pointer, pointer, pointer, pointer]

    def call(theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        steps, batch = w.shape
        cost, result = np.empty(batch), np.empty((steps, batch))
        if library.pushing(ctypes.byref(values), steps, batch, theta, np.ascontiguousarray(w), cost, result):
            raise ValueError(f"the kernel takes batches that are multiples of {LANES}, not {batch}")
        return result

    return call


def _library() -> ctypes.CDLL:
    compiler = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
    if compiler is None:
        raise Unavailable("no C compiler (cc, gcc, clang) was found")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pushing.so"
        source = Path(__file__).with_name("pushing.c")
        done = subprocess.run([compiler, *FLAGS, str(source), "-o", str(path)], capture_output=True, text=True)
        if done.returncode:
            raise Unavailable(f"{compiler} failed: {done.stderr.strip()[:200]}")
        return ctypes.CDLL(str(path))
