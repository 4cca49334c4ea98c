"""The backend checkpointed: the gradient of jax from what is kept, and memory that grows as its levels promise."""

import math

import numpy as np
import pytest

import bench
from bench.model import Compilations

pytest.importorskip("jax")

from bench.plugins.backends import compiling
from bench.plugins.backends.checkpointed import _nested

BATCH = 256
"""Rollouts, so that the states dominate the memory."""
ORDERS = {0: 1.0, 1: 1.0, 2: 1 / 2, 3: 1 / 3}
"""p in memory ~ T^p by levels of checkpoints."""
ROUNDED = 0.06
"""Error of p between 4,096 and 262,144 steps: some arrays of one step are kept at any horizon."""


@pytest.mark.parametrize("levels", ORDERS)
def test_memory_grows_with_the_horizon_as_the_levels_promise(levels):
    """In the compiler's own plan of its buffers, for x = x + sin(x) / T, whose derivative needs each x."""
    import jax
    import jax.numpy as jnp

    def planned(steps):
        def end(x):
            return jnp.sum(_nested(lambda x, _: [x[0] + jnp.sin(x[0]) / steps], [x], None, steps, levels)[0])

        compiled = jax.jit(jax.grad(end)).lower(jnp.ones(BATCH)).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    short, long = planned(4096), planned(262144)
    assert math.log(long / short) / math.log(64) == pytest.approx(ORDERS[levels], abs=ROUNDED)


@pytest.mark.slow
def test_backends_that_keep_something_else_share_no_executable():
    shapes = set()
    for backend in ("checkpointed[levels=1]", "checkpointed[levels=2]", "checkpointed[keep=everything]", "jax"):
        problem = bench.problem("cartpole[horizon=3]", backend=backend)
        problem.grad(problem.program.theta0, np.ones((problem.program.n_noise, 3)))
        shapes |= problem.compilations.shapes
    assert len(shapes) == 4


def test_the_executables_used_last_are_kept(monkeypatch):
    monkeypatch.setattr(compiling, "_known", {})
    monkeypatch.setattr(compiling, "KEPT", 3)
    count = Compilations(None)

    def power(n):
        """x^n, compiled for each n."""
        made = compiling.compiled(("power", n), lambda x: x**n + 0.5 * n, (np.ones(3),), False, count)
        return np.asarray(made.call(2.0 * np.ones(3)))

    for n in (1, 2, 3, 1, 4, 1):  # 2 was used longest ago when 4 comes
        power(n)
    assert count.made == 4
    assert power(2) == pytest.approx(2.0**2 + 1.0)  # compiled again, the same numbers
    assert count.made == 5
