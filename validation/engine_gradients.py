"""Prints an engine's gradients without noise and their distance from NumPy's at 64 samples: ``engine_gradients.py ENGINE [SCENE ...]``.

It also says whether two equal calls return equal bits, with a hash of them: equal hashes of two runs are equal bits.
ENGINE may have parameters: ``'newton[solver=semi_implicit]'``. Its Python is that of `python -m bench engines install`.
"""

import hashlib
import sys

import numpy as np

from bench.errors import Unavailable, Unsupported
from bench.experiment import by_name

SCENES = ("bounce_once", "bouncing_ball", "pushing", "cartpole", "hopper")
COLUMNS = 64


def main():
    """Print a line per scene of an engine."""
    engine, *scenes = sys.argv[1:]
    law = getattr(by_name.make("backends", engine), "laws", ("penalty",))[0]
    for name in scenes or SCENES:
        try:
            problem, own = (
                by_name.compile_problem(name, law, "semi_implicit_euler", backend) for backend in (engine, "numpy")
            )
        except (Unavailable, Unsupported) as error:
            print(f"{name:<14} {error}")
            continue
        theta, w = own.program.theta0, np.random.default_rng(0).standard_normal((own.program.n_noise, COLUMNS))
        what = "grad" if "grad" in problem.provides else "value"
        call = getattr(problem, what)
        result, expected, still = call(theta, w), getattr(own, what)(theta, w), call(theta, 0.0 * w[:, :1])
        off = np.abs(result - expected).max() / np.abs(expected).max()
        bits = "equal" if call(theta, w).tobytes() == result.tobytes() else "different"
        print(
            f"{name:<14} {np.ravel(still)[:2]}  from NumPy {off:.1e}  again {bits} "
            f"{hashlib.sha256(result.tobytes()).hexdigest()[:8]}",
            flush=True,
        )


if __name__ == "__main__":
    main()
