"""The native baseline: a fused C loop with a hand-written adjoint, compiled by the system's compiler."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-O3", "-march=native", "-fno-trapping-math", "-shared", "-fPIC")
"""Without traps a choice between two numbers is vectorised; no number changes."""
LANES = 32
"""Batch sizes must be a multiple of this number."""


class Unavailable(Exception):
    """Raised if no compiler is installed or the compiler fails."""


class Parameters(ctypes.Structure):
    """Parameters of the scene and its contact law."""

    _fields_ = [(name, ctypes.c_double) for name in ("dt", "mass", "factor", "speed", "sigma", "stiffness")]


def gradient(scene, stiffness):
    """Return the function from ``theta (T,)`` and ``w (T, B)`` to df/dtheta ``(T, B)``. Raises :class:`Unavailable`."""
    library = _library()
    values = Parameters(scene.dt, scene.mass, scene.velocity_factor, scene.speed, scene.sigma, stiffness)
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    size = ctypes.c_size_t
    library.pushing.argtypes = [ctypes.POINTER(Parameters), size, size, pointer, pointer, pointer, pointer]

    def call(theta, w):
        steps, batch = w.shape
        cost, result = np.empty(batch), np.empty((steps, batch))
        if library.pushing(ctypes.byref(values), steps, batch, theta, np.ascontiguousarray(w), cost, result):
            raise ValueError(f"the kernel takes batches that are multiples of {LANES}, not {batch}")
        return result

    return call


def _library():
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise Unavailable(f"no C compiler ({', '.join(COMPILERS)}) was found")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pushing.so"
        source = Path(__file__).with_name("pushing.c")
        done = subprocess.run([compiler, *FLAGS, str(source), "-o", str(path)], capture_output=True, text=True)
        if done.returncode:
            raise Unavailable(f"{compiler} failed: {done.stderr.strip()[:200]}")
        return ctypes.CDLL(str(path))
