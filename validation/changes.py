"""Plugins that change the process: precision, error states, seeds, threads, default types and functions.

:func:`plugin` is the source of an estimator that is the sample mean of gradients and changes one thing.
"""

from __future__ import annotations

CHANGES = {
    "x64": "import jax; jax.config.update('jax_enable_x64', False)",
    "seterr": "np.seterr(all='raise')",
    "np_draw": "np.random.rand()",
    "seed": "import random; random.seed(1)",
    "special_errors": "import scipy.special; scipy.special.seterr(all='raise')",
    "dtype": "import torch; torch.set_default_dtype(torch.float16)",
    "torch_threads": "import torch; torch.set_num_threads(3)",
    "torch_seed": "import torch; torch.manual_seed(1)",
    "no_grad": "import torch; torch.set_grad_enabled(False)",
    "special": "import sys; sys.modules['scipy.special'] = None",
    "blas_threads": "import threadpoolctl; threadpoolctl.threadpool_limits(5)",
    "sqrt": "np.sqrt = np.square",
    "norm": "np.linalg.norm = np.linalg.det",
    "own_method": "from bench.model import SampleMean; SampleMean.estimate = None",
}
"""Code that changes one thing, by kind."""


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
        {CHANGES[kind]}
        return gradient
'''
