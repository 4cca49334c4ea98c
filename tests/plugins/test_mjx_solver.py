"""Gradients through MJX's converged solver: dropped terms are caught. ``tests/engines/test_conformance_set.py`` has mechanisms."""

import numpy as np
import pandas as pd
import pytest
from classes import Numpy
from helpers import need_backends

from bench.cli import main
from bench.engines import conformance
from bench.plugins import mjx_solver

need_backends("mujoco", "mjx")


# ------------------------------------------------------------------------------------------- without compilation


def test_engine_has_its_own_solver_outside_the_context():
    from mujoco.mjx._src import solver

    own = mjx_solver.library().solve
    with mjx_solver.implicit():
        assert solver.solve is mjx_solver.solve
    assert solver.solve is own
    with pytest.raises(AttributeError), mjx_solver.implicit():
        mjx_solver.solve(None, None)
    assert solver.solve is own


def row(residual, tmp_path, monkeypatch):
    """Return the row of a backend whose solver has this residual."""

    def solver_residual(self, problem, w):
        assert w.shape == (problem.program.n_noise, 3)
        return residual

    monkeypatch.setattr(Numpy, "solver_residual", solver_residual, raising=False)
    monkeypatch.setattr(Numpy, "remarks", lambda self, program: ["no wind", "no rain"], raising=False)
    words = [
        "scenes=[double_integrator]",
        "backends=[numpy]",
        "estimators=[fobg]",
        "samples=3",
        "repeats=2",
        "workers=0",
    ]
    assert main([*words, "name=mine", "timing=false", "reference.samples=256", f"results_dir={tmp_path}"]) == 0
    return pd.read_parquet(tmp_path / "mine" / "rows.parquet").iloc[0]


@pytest.mark.parametrize("residual", [1e-3, 1e-12])
def test_row_has_the_residual_and_a_remark_where_the_solver_has_not_converged(residual, tmp_path, monkeypatch):
    found = row(residual, tmp_path, monkeypatch)
    assert found["solver_residual"] == residual
    remark = "the constraint solver has not converged (relative residual 1.0e-03)"
    assert ("converged" in found["reason"]) == (remark in found["reason"]) == (residual > 1e-8)
    assert "physics: no wind; physics: no rain" in found["reason"]
    assert found["status"] == "ok"


@pytest.mark.slow
def test_mjx_loses_the_derivative_of_a_rotation_by_an_angular_velocity_of_zero():
    """A limit of MJX, named in the documentation: were it repaired, the documentation would be wrong."""
    import jax
    from mujoco.mjx._src import math

    def turned(rate):
        return math.quat_integrate(np.array([1.0, 0, 0, 0]), rate, 0.01)

    assert np.all(jax.jacfwd(turned)(np.zeros(3)) == 0)
    np.testing.assert_allclose(jax.jacfwd(turned)(np.array([0.01, 0, 0]))[1, 0], 0.005, rtol=1e-4)


# ------------------------------------------------------------------------------------------------------- agreement


CASES = ("ball_limit", "connect_fast", "slide_limit")
"""In these, constraint Jacobian, mass matrix and impedance depend on the state."""
TERMS = [
    pytest.param("_impl.efc_J", CASES[:1], marks=pytest.mark.slow),
    pytest.param("_impl.M", CASES[1:2], marks=pytest.mark.slow),
    *(pytest.param(term, CASES, marks=pytest.mark.full) for term in ("_impl.efc_aref", "_impl.efc_D", "qfrc_smooth")),
]


@pytest.mark.parametrize(("dropped", "cases"), TERMS)
def test_dropped_term_of_the_derivative_is_caught(dropped, cases, monkeypatch):
    import jax
    from bench.plugins.engines.mjx_conformance import Engine

    gradient = mjx_solver._cost_gradient

    def incomplete(model, data, acceleration):
        part = data
        for name in dropped.split("."):
            part = getattr(part, name)
        return gradient(model, data.tree_replace({dropped: jax.lax.stop_gradient(part)}), acceleration)

    monkeypatch.setattr(mjx_solver, "_cost_gradient", incomplete)
    assert any(row["is_right"] is False for case in cases for row in conformance.run(Engine(), case))
