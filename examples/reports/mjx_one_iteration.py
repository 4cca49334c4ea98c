"""MJX: the derivative with one solver iteration is that of another program.

MJX has no reverse mode through the loop of its solver (issue 2259 of google-deepmind/mujoco; 3583 unrolls it), so users set
``iterations=1``. For a sliding ball over 8 steps the cost is then 1.2302 instead of 0.6394, and its derivative by the forward velocity
-3.388 instead of -4.604. Two Newton steps on the converged accelerations, the last of them differentiated, agree with differences of the C
engine to 10 digits: ``plugins/mjx_solver.py`` has them in 60 lines.
"""

from bench.plugins.engines.mjx_conformance import Engine

from bench.engines import conformance

(case,) = conformance.cases("pyramidal_slide")
for engine in (Engine(is_implicit=False, iterations=1), Engine()):
    print(engine.rollout(case), engine.gradient(case)["qvel"][0])
