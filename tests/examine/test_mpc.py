"""The example of a predictive controller: its forces, its derivative and the planted fault."""

import runpy
from pathlib import Path

import jax
import numpy as np
from scipy.optimize import lsq_linear

MPC = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "mpc.py"))
EXPERT = np.array([0.0, 2.0, -2.0, -1.0])
SAME = 1e-9
"""Absolute difference in N allowed from another solver of the same program, whose Hessian has a condition of 1e3."""


def test_forces_solve_the_quadratic_program():
    """Against scipy's bounded least squares, an active-set method, on the same states."""
    plans = jax.jit(jax.vmap(MPC["plan"], (None, 0)))
    weights = np.sqrt(np.tile(np.exp(EXPERT), MPC["STEPS"]))
    for start, forces in zip(MPC["STARTS"], plans(EXPERT, MPC["STARTS"]), strict=True):
        rows = np.concatenate([weights[:, None] * MPC["FORCED"], np.sqrt(0.1) * np.eye(MPC["STEPS"])])
        right = np.concatenate([-weights * (MPC["FREE"] @ start), np.zeros(MPC["STEPS"])])
        limits = (-MPC["LIMIT"], MPC["LIMIT"])
        expected = lsq_linear(rows, right, limits, method="bvls", tol=1e-15).x
        np.testing.assert_allclose(forces, expected, atol=SAME)
