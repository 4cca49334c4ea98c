"""Brax's generalized pipeline in the conformance set, differentiated forward by JAX."""

import importlib.metadata

import jax
import mujoco
from brax.generalized import pipeline
from brax.io import mjcf

jax.config.update("jax_enable_x64", True)


class Engine:
    """A compiled gradient per case, with the cost."""

    versions = {name: importlib.metadata.version(name) for name in ("brax", "jax")}

    tolerance = 1e-3  # the solver of contacts and limits stops early

    def __init__(self):
        self.differs, self._compiled = {}, {}

    def _run(self, case):
        if case.name not in self._compiled:
            model = mujoco.MjModel.from_xml_path(str(case.model))
            different = {
                "forces f >= 0 of contacts minimise |A f + b|^2": model.npair
                or (model.geom_contype.any() and model.ngeom > 1),
                "no fluids and no gravity compensation": model.opt.viscosity or model.body_gravcomp.any(),
                "no friction loss": model.dof_frictionloss.any(),
                "no equalities": model.neq,
                "no tendons": model.ntendon,
                "a motor has one axis": model.actuator_gear[:, 1:].any(),
            }
            self.differs[case.name] = "; ".join(reason for reason, is_so in different.items() if is_so)
            system = mjcf.load_model(model).replace(solver_maxls=60)

            def cost(q, v, controls):
                step = lambda state, u: (pipeline.step(system, state, u), None)  # noqa: E731
                state, _ = jax.lax.scan(step, pipeline.init(system, q, v), controls)
                return (case.cost(state.q, state.qd),) * 2

            self._compiled[case.name] = jax.jit(jax.jacfwd(cost, (0, 1, 2), has_aux=True))
        return self._compiled[case.name](case.qpos, case.qvel, case.controls)

    def rollout(self, case):
        """Return the cost of a case."""
        return float(self._run(case)[1])

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        return dict(zip(("qpos", "qvel", "controls"), self._run(case)[0], strict=True))
