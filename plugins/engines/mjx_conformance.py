"""MJX in the conformance set, differentiated through the converged solver, and in the checks without a reference."""

from __future__ import annotations

import contextlib
import functools
from typing import Any

import jax
import mujoco
import numpy as np
from bench.plugins.engines import mujoco_conformance
from bench.plugins.engines.mujoco_conformance import TERMS, place
from bench.plugins.mjcf import mjx_remarks

from bench.plugins import mjx_solver

jax.config.update("jax_enable_x64", True)
mjx = mjx_solver.library()
VERSIONS = {"mujoco-mjx": mujoco.__version__, "jax": jax.__version__}


def on_device(model: Any) -> tuple[Any, Any]:
    """Return MJX's model, and its data in float64."""
    data = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, mjx.make_data(model))
    return mjx.put_model(model), data


def rolled(model: Any, data: Any, q: Any, v: Any, controls: Any) -> Any:
    """Return the last state of a rollout. Warm starts of the solver have no derivative."""

    def step(data: Any, u: Any) -> Any:
        after = mjx.step(model, data.replace(ctrl=u))
        after = after.replace(qacc_warmstart=jax.lax.stop_gradient(after.qacc_warmstart))
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, data), None

    end, _ = jax.lax.scan(step, data.replace(qpos=q, qvel=v), controls)
    return end.qpos, end.qvel


class Model(mujoco_conformance.Model):
    """A model from MJCF text, compiled when it is first called. Gaps and loops are those of the C engine's geometry."""

    jacobian = None  # type: ignore[assignment]

    def __init__(self, mjcf: str) -> None:
        super().__init__(mjcf)
        self.remarks = mjx_remarks(self.model)
        model, data = on_device(self.model)
        rollout = functools.partial(rolled, model, data)
        self._forward = jax.jit(lambda q, v, u: mjx.forward(model, data.replace(qpos=q, qvel=v, ctrl=u)))
        self._rollout, self._rollouts = jax.jit(rollout), jax.jit(jax.vmap(rollout))

    def forward(self, q: Any, v: Any = 0.0, u: Any = 0.0) -> Any:
        """Return data with accelerations and forces at a state."""
        return self._forward(q, v + np.zeros(self.model.nv), u + np.zeros(self.model.nu))

    def reference(self, q: Any, v: Any, u: Any) -> np.ndarray:
        """Return the C engine's accelerations."""
        return np.array(super().forward(q, v, u).qacc)

    def rollout(self, q: Any, v: Any, controls: Any) -> Any:
        """Return the last state of a rollout."""
        return self._rollout(q, v, controls)

    def steps(self, q: Any, v: Any, u: Any) -> Any:
        """Return the next states of rows of states, by vmap."""
        return self._rollouts(q, v, u[:, None])


class Engine:
    """A compiled function per case. ``is_implicit`` differentiates through the converged solver; ``options`` replace the models'."""

    versions = VERSIONS
    differs = {
        **dict.fromkeys(("connect", "connect_fast", "weld"), "MJX has no velocity product J-dot v in these rows"),
        **dict.fromkeys(("box_tilted", "sparse_chain"), "MJX has other contacts of boxes and capsules"),
    }

    def __init__(self, is_implicit: bool = True, **options: Any) -> None:
        self._solver = mjx_solver.implicit if is_implicit else contextlib.nullcontext
        self._options = options
        self._compiled: dict[str, Any] = {}

    def _compile(self, case: Any) -> Any:
        """Return the compiled function of start, controls and parameter: the cost and its derivatives."""
        source = mujoco.MjModel.from_xml_path(str(case.model))
        for name, value in self._options.items():
            setattr(source.opt, name, value)
        owner, field, index = place(source, case)
        name = f"opt.{field}" if owner is source.opt else field
        model, data = on_device(source)
        old = jax.numpy.asarray(functools.reduce(getattr, name.split("."), model), float)

        def cost(q: Any, v: Any, controls: Any, parameter: Any) -> Any:
            own = model.tree_replace({name: old.at[index].set(parameter)})
            with self._solver():
                return case.cost(*rolled(own, data, q, v, controls))

        return jax.jit(jax.value_and_grad(cost, (0, 1, 2, 3)))

    def _run(self, case: Any) -> Any:
        if case.name not in self._compiled:
            self._compiled[case.name] = self._compile(case)
        return self._compiled[case.name](case.qpos, case.qvel, case.controls, case.parameter)

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        return float(self._run(case)[0])

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives, in reverse mode."""
        return dict(zip(TERMS, map(np.asarray, self._run(case)[1]), strict=True))
