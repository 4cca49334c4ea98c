"""Prints an engine's gradients without noise, their distance from NumPy's, and the times of 64: ``engine_gradients.py ENGINE [SCENE ...]``.

It also says whether two equal calls return equal bits, with a hash of them: equal hashes of two runs are equal bits.
ENGINE may have parameters: ``'newton[solver=semi_implicit]'``. Its Python is that of `python -m bench engines install`.
"""

import hashlib
import sys
import time

import numpy as np

from bench.engines.problem import EngineProblem
from bench.experiment import by_name
from bench.model import compose, registry
from bench.model.parameters import build, parameters

SCENES = ("bounce_once", "bouncing_ball", "pushing", "cartpole", "hopper")
COLUMNS = 64


def main():
    """Print a line per scene of an engine."""
    engine, *scenes = sys.argv[1:]
    backend = by_name.make("backends", engine)
    integrator = registry.make("integrators", "semi_implicit_euler")
    for name in scenes or SCENES:
        scene = registry.make("scenes", name)
        laws = getattr(backend, "laws", ("penalty",)) if scene.n_contacts else (None,)
        law = None
        if laws[0] is not None:
            plugin = registry.usable("contacts", laws[0])
            law = build(plugin, {k: v for k, v in scene.contact_values.items() if k in parameters(plugin)})
        program = compose(scene, law, integrator)
        if reason := backend.unavailable_reason() or backend.refusal(program):
            print(f"{name:<14} {reason}")
            continue
        problem, own = backend.compile(program), registry.make("backends", "numpy").compile(program)
        w = np.random.default_rng(0).standard_normal((program.n_noise, COLUMNS))
        function = problem.grad if "grad" in backend.provides else problem.value
        expected = own.grad(program.theta0, w) if "grad" in backend.provides else own.value(program.theta0, w)
        started = time.perf_counter()
        before = function(program.theta0, w)
        first = time.perf_counter() - started
        inside = (problem.engine_s, problem.pipe_s) if isinstance(problem, EngineProblem) else (0.0, 0.0)
        started = time.perf_counter()
        result = function(program.theta0, w)
        seconds = time.perf_counter() - started
        shares = ""
        if isinstance(problem, EngineProblem):
            parts = (problem.engine_s - inside[0], problem.pipe_s - inside[1])
            shares = f"  engine {parts[0] / seconds:.0%} pipe {parts[1] / seconds:.1%}"
        still = function(program.theta0, 0.0 * w[:, :1])
        off = np.abs(result - expected).max() / np.abs(expected).max()
        bits = "equal" if before.tobytes() == result.tobytes() else "different"
        print(
            f"{name:<14} {np.ravel(still)[:2]}  from NumPy {off:.1e}  first {first:.1f} s  then {seconds:.3f} s{shares}"
            f"  again {bits} {hashlib.sha256(result.tobytes()).hexdigest()[:8]}",
            flush=True,
        )


if __name__ == "__main__":
    main()
