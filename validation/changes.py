"""Plugins that change the process, one for each way in which a change is found, with code and the words that name it.

:func:`plugin` is the source of an estimator that is the sample mean of gradients and changes one thing.
"""

from __future__ import annotations

CHANGES = {
    "x64": ("import jax; jax.config.update('jax_enable_x64', False)", "JAX's configuration (jax_enable_x64)"),
    "seterr": ("np.seterr(all='raise')", "NumPy's error state (divide, invalid, over, under)"),
    "np_draw": ("np.random.rand()", "the seed of numpy.random"),
    "seed": ("import random; random.seed(1)", "the seed of random"),
    "special_errors": ("import scipy.special; scipy.special.seterr(all='raise')", "SciPy's error state"),
    "dtype": ("import torch; torch.set_default_dtype(torch.float16)", "torch's default type"),
    "torch_threads": ("import torch; torch.set_num_threads(3)", "torch's threads"),
    "torch_seed": ("import torch; torch.manual_seed(1)", "the seed of torch"),
    "no_grad": ("import torch; torch.set_grad_enabled(False)", "torch's gradients"),
    "special": ("import sys; sys.modules['scipy.special'] = None", "SciPy's error state"),
    "blas_threads": ("import threadpoolctl; threadpoolctl.threadpool_limits(5)", "the threads of linear algebra"),
}  # fmt: skip
"""Code that changes one setting, and the words that name the change, by kind."""
REPLACES = {
    "sqrt": ("np.sqrt = np.square", ""),
    "norm": ("np.linalg.norm = np.linalg.det", ""),
    "own_method": ("from bench.model import SampleMean; SampleMean.estimate = None", ""),
}
"""Code that replaces a function, which no comparison of settings finds."""


def plugin(kind: str) -> str:
    """Return the source of an estimator named ``changes_KIND`` that changes one thing at each call."""
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
        {(CHANGES | REPLACES)[kind][0]}
        return gradient
'''
