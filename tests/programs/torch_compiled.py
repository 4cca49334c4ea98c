"""Measures whether torch.compile would make the torch backend faster: ``python tests/programs/torch_compiled.py``.

Prints, by horizon, the seconds to compile one gradient of ``pushing`` under the penalty law without a cache on disk, and the
microseconds per rollout, eager and compiled, for batches of 1,000 and 100,000 rollouts. torch unrolls the loop over time, so
compile time grows with the horizon. No horizon follows one that compiles for more than ``PATIENCE`` seconds.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable

import numpy as np

from bench.model import compose, registry

PATIENCE = 120.0
HORIZONS = (3, 10, 30, 100)
SIZES = (1_000, 100_000)


def main() -> None:
    """Print the table."""
    import torch

    backend = registry.make("backends", "torch")
    for horizon in HORIZONS:
        scene = registry.make("scenes", "pushing", {"horizon": horizon})
        program = compose(
            scene, registry.make("contacts", "penalty"), registry.make("integrators", "semi_implicit_euler")
        )
        problem = backend.compile(program)

        def cost(theta: torch.Tensor, w: torch.Tensor, problem=problem) -> torch.Tensor:  # type: ignore[no-untyped-def]
            return problem.program.cost(problem._ops, theta, w)

        compiled = torch.compile(cost)
        spent = 0.0
        for size in SIZES:
            rng = np.random.default_rng(0)
            theta = torch.tensor(np.broadcast_to(program.theta0[:, None], (problem.dim, size)).copy())
            w = torch.tensor(rng.standard_normal((program.n_noise, size)))
            eager, _ = gradient(cost, theta, w)
            found, taken = gradient(compiled, theta, w)
            spent += taken
            assert torch.allclose(eager, found, rtol=1e-9, atol=1e-9), "the compiled gradient is another one"
            times = [min(gradient(f, theta, w)[1] for _ in range(5)) / size * 1e6 for f in (cost, compiled)]
            print(
                f"horizon {horizon:4d}, {size:7,d} rollouts: eager {times[0]:7.2f} us, compiled {times[1]:7.2f} us per "
                f"rollout, {times[0] / times[1]:.1f} times as fast; compiled in {taken:.0f} s",
                flush=True,
            )
        if spent > PATIENCE:
            break


def gradient(function: Callable[..., object], theta: object, w: object) -> tuple[object, float]:
    """Return the gradient of the summed costs by theta ``(d, B)``, and the seconds it took."""
    import torch

    full = theta.detach().clone().requires_grad_()  # type: ignore[attr-defined]
    since = time.perf_counter()
    result = function(full, w)
    (slope,) = torch.autograd.grad(result.sum(), full)  # type: ignore[attr-defined]
    return slope, time.perf_counter() - since


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = folder
        main()
