"""Plugins that change the process, one for each kind of state, with code that changes it and the words that name it.

:func:`plugin` is the source of an estimator that is the sample mean of gradients and changes one kind of state.
"""

from __future__ import annotations

CHANGES = {
    "x64": ("import jax; jax.config.update('jax_enable_x64', False)", "jax_enable_x64"),
    "matmul": ("import jax; jax.config.update('jax_default_matmul_precision', 'bfloat16')", "jax_default_matmul_precision"),
    "nans": ("import jax; jax.config.update('jax_debug_nans', True)", "jax_debug_nans"),
    "no_jit": ("import jax; jax.config.update('jax_disable_jit', True)", "jax_disable_jit"),
    "promotion": ("import jax; jax.config.update('jax_numpy_dtype_promotion', 'strict')", "jax_numpy_dtype_promotion"),
    "prng": ("import jax; jax.config.update('jax_default_prng_impl', 'rbg')", "jax_default_prng_impl"),
    "threefry": ("import jax; jax.config.update('jax_threefry_partitionable', not jax.config.jax_threefry_partitionable)", "jax_threefry_partitionable"),
    "grad": ("import jax; jax.grad = jax.value_and_grad", "jax.grad"),
    "jnp_sum": ("import jax.numpy; jax.numpy.sum = jax.numpy.max", "jax.numpy.sum"),
    "scan": ("import jax; jax.lax.scan = jax.lax.fori_loop", "jax.lax.scan"),
    "seterr": ("np.seterr(all='raise')", "NumPy's error state (divide, invalid, over, under)"),
    "seterrcall": ("np.seterrcall(lambda *_: None)", "NumPy's error handler"),
    "bufsize": ("np.setbufsize(16)", "NumPy's buffer size"),
    "np_seed": ("np.random.seed(1)", "the seed of numpy.random"),
    "np_draw": ("np.random.rand()", "the seed of numpy.random"),
    "norm": ("np.linalg.norm = np.linalg.det", "numpy.linalg.norm"),
    "mean": ("np.mean = np.sum", "numpy.mean"),
    "sqrt": ("np.sqrt = np.square", "numpy.sqrt"),
    "pi": ("np.pi = 3.0", "numpy.pi"),
    "default_rng": ("np.random.default_rng = None", "numpy.random.default_rng"),
    "deleted": ("del np.quantile", "numpy.quantile"),
    "solve": ("import scipy.linalg; scipy.linalg.solve = None", "scipy.linalg.solve"),
    "root": ("import scipy.optimize; scipy.optimize.root = None", "scipy.optimize.root"),
    "ndtr": ("import scipy.special; scipy.special.ndtr = None", "scipy.special.ndtr"),
    "special_errors": ("import scipy.special; scipy.special.seterr(all='raise')", "SciPy's error state"),
    "fft_workers": ("import scipy.fft; scipy.fft.kept = scipy.fft.set_workers(2); scipy.fft.kept.__enter__()", "the threads of scipy.fft"),
    "dtype": ("import torch; torch.set_default_dtype(torch.float16)", "torch's default type"),
    "torch_threads": ("import torch; torch.set_num_threads(3)", "torch's threads"),
    "torch_seed": ("import torch; torch.manual_seed(1)", "the seed of torch"),
    "no_grad": ("import torch; torch.set_grad_enabled(False)", "torch's gradients"),
    "deterministic": ("import torch; torch.use_deterministic_algorithms(True)", "torch's deterministic algorithms"),
    "anomaly": ("import torch; torch.autograd.set_detect_anomaly(True)", "torch's anomaly detection"),
    "precision": ("import torch; torch.set_float32_matmul_precision('medium')", "torch's precision of matrix products"),
    "denormal": ("import torch; torch.set_flush_denormal(True)", "denormal numbers"),
    "torch_sum": ("import torch; torch.sum = torch.mean", "torch.sum"),
    "tensor": ("import torch; torch.Tensor.sum = torch.Tensor.mean", "torch.Tensor.sum"),
    "environment": ("os.environ['JAX_ENABLE_X64'] = '0'; os.environ.pop('HOME', None)", "environment variables (HOME, JAX_ENABLE_X64)"),
    "folder": ("os.chdir('/')", "the working folder"),
    "locale": ("import locale; locale.setlocale(locale.LC_ALL, 'C' if locale.setlocale(locale.LC_ALL) != 'C' else 'C.UTF-8')", "the locale"),
    "warnings": ("import warnings; warnings.filterwarnings('error', 'of my own')", "warnings as errors"),
    "recursion": ("import sys; sys.setrecursionlimit(777)", "the recursion limit"),
    "path": ("import sys; sys.path.insert(0, '/nowhere')", "the import path"),
    "garbage": ("import gc; gc.disable()", "garbage collection"),
    "seed": ("import random; random.seed(1)", "the seed of random"),
    "rounding": ("import ctypes; ctypes.CDLL(None).fesetround({'x86_64': 0x400, 'aarch64': 0x800000}[__import__('platform').machine()])", "the rounding mode"),
    "decimal": ("import decimal; decimal.getcontext().prec = 3", "the decimal context"),
    "blas_threads": ("import threadpoolctl; threadpoolctl.threadpool_limits(5)", "the threads of linear algebra"),
    "cores": ("os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})", "the processor cores"),
    "builtin": ("import builtins; builtins.sum = max", "builtins.sum"),
    "math": ("import math; math.sqrt = math.exp", "math.sqrt"),
    "json": ("import json; json.dumps = lambda *_, **__: 'null'", "json.dumps"),
    "clock": ("import time; time.perf_counter = time.time", "time.perf_counter"),
    "own_function": ("import bench.measure.statistics as s; s.summarise = None", "bench.measure.statistics.summarise"),
    "own_method": ("from bench.model import SampleMean; SampleMean.estimate = None", "bench.model.estimator.SampleMean.estimate"),
    "other_plugin": ("from bench.plugins.estimators.reinforce import Reinforce; Reinforce.terms = None", "bench.plugins.estimators.reinforce.Reinforce.terms"),
    "hidden": ("from bench.plugins.estimators.fobg import Fobg; Fobg.estimate = lambda *_: 0.0", "bench.plugins.estimators.fobg.Fobg.estimate"),
    "hidden_builtin": ("import bench.measure.statistics as s; s.sum = max", "bench.measure.statistics.sum"),
    "two": ("np.seterr(over='raise'); import random; random.seed(3)", "NumPy's error state (over)"),
}  # fmt: skip
"""Code that changes one kind of state, and the words that name the change, by kind."""


def plugin(kind: str) -> str:
    """Return the source of an estimator named ``changes_KIND`` that changes one kind of state at each call."""
    return f'''
"""Changes the process."""

import os
from dataclasses import dataclass

import numpy as np

from bench.model import SampleMean


@dataclass(frozen=True)
class Changes(SampleMean):
    """The mean of gradients, which changes the process."""

    name = "changes_{kind}"
    needs = frozenset({{"grad"}})

    def terms(self, problem, theta, w):
        """Gradients."""
        gradient = problem.grad(theta, w)
        {CHANGES[kind][0]}
        return gradient
'''
