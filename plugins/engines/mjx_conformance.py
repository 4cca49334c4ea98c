"""MJX in the conformance set: all cases of equal options in one model, differentiated through the converged solver."""

from __future__ import annotations

import contextlib
import functools
import re
from typing import Any

import jax
import mujoco
import numpy as np
from bench.plugins.engines.mujoco_conformance import TERMS, place

from bench.engines.conformance import cases
from bench.plugins import mjx_solver

jax.config.update("jax_enable_x64", True)
APART = 20.0
"""Distance of two cases in a model [m]."""


class Engine:
    """Cases that share a group are compiled together. ``is_implicit`` differentiates through the converged solver."""

    versions = {"mujoco-mjx": mujoco.__version__, "jax": jax.__version__}
    differs = {
        **dict.fromkeys(("connect", "connect_fast", "weld"), "MJX has no velocity product J-dot v in these rows"),
        "sparse_chain": "MJX keeps other contacts of boxes and capsules",
    }

    def __init__(self, *names: str, is_implicit: bool = True, **options: Any) -> None:
        self._groups: dict[str, Group] = {}
        by_options: dict[str, list[Any]] = {}
        for case in cases(*names):
            (own,) = re.findall("<option.*>", case.model.read_text())
            by_options.setdefault(f"{len(case.controls)} {own}", []).append(case)
        for members in by_options.values():
            self._groups |= dict.fromkeys((case.name for case in members), Group(members, is_implicit, options))

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        return self._groups[case.name].rollout(case)

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives, in reverse mode."""
        return self._groups[case.name].gradient(case)


class Group:
    """A model of several cases, each at its own place and with contacts among its own geoms only."""

    def __init__(self, members: list[Any], is_implicit: bool, options: dict[str, Any]) -> None:
        self._members = {case.name: case for case in members}
        self._solver = mjx_solver.implicit if is_implicit else contextlib.nullcontext
        spec = mujoco.MjSpec()
        for i, case in enumerate(members):
            part = mujoco.MjSpec.from_file(str(case.model))
            for geom in part.geoms:
                geom.contype, geom.conaffinity = geom.contype << i, geom.conaffinity << i
            for name in (
                "timestep",
                "integrator",
                "cone",
                "jacobian",
                "impratio",
                "tolerance",
                "iterations",
                "ls_iterations",
            ):
                setattr(spec.option, name, getattr(part.option, name))
            spec.attach(part, prefix=f"{case.name}/", frame=spec.worldbody.add_frame(pos=[0, APART * i, 0]))
        self._model = spec.compile()
        for name, value in options.items():
            setattr(self._model.opt, name, value)
        self._shift = self._model.qpos0 - np.concatenate(
            [mujoco.MjModel.from_xml_path(str(case.model)).qpos0 for case in members]
        )
        self._places = [place(self._model, case, f"{case.name}/") for case in members]

    @functools.cached_property
    def _cost(self) -> Any:
        """Return the compiled function of start, controls, parameters and weights: the cost and its derivatives by the first four."""
        mjx = mjx_solver.library()
        model, data = mjx.put_model(self._model), mjx.make_data(self._model)
        data = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, data)

        def cost(q: Any, v: Any, controls: Any, parameters: Any, weights: Any) -> Any:
            changed: dict[str, Any] = {}
            for value, case, (owner, field, index) in zip(
                parameters, self._members.values(), self._places, strict=True
            ):
                name = f"opt.{field}" if owner is self._model.opt else field
                old = getattr(model.opt if owner is self._model.opt else model, field)
                changed[name] = changed.get(name, jax.numpy.asarray(old, float)).at[index].add(value - case.parameter)
            own = model.tree_replace(changed)

            def step(at: Any, u: Any) -> Any:
                with self._solver():
                    after = mjx.step(own, data.replace(qpos=at[0], qvel=at[1], ctrl=u, qacc_warmstart=at[2]))
                return (after.qpos, after.qvel, jax.lax.stop_gradient(after.qacc)), None

            (q, v, _), _ = jax.lax.scan(step, (q, v, 0.0 * v), controls)
            return weights[0] @ q + weights[1] @ v

        return jax.jit(jax.value_and_grad(cost, (0, 1, 2, 3)))

    def _slice(self, case: Any, field: str) -> slice:
        """Return the part of all cases' values that is a case's."""
        sizes = [len(np.atleast_1d(getattr(other, field).T)) for other in self._members.values()]
        number = list(self._members).index(case.name)
        return slice(sum(sizes[:number]), sum(sizes[: number + 1]))

    def _run(self, case: Any) -> Any:
        """Return a case's cost and its derivatives, with all other cases as stored."""
        members = (self._members | {case.name: case}).values()
        q, v, *others = (np.hstack([getattr(each, term) for each in members]) for term in TERMS)
        weights = [np.zeros(len(q)), np.zeros(len(v))]
        for term, weight in zip(TERMS, weights, strict=False):
            weight[self._slice(case, term)] = case.data["weights"][term]
        value, slopes = self._cost(q + self._shift, v, *others, weights)
        return value - weights[0] @ self._shift, slopes

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        return float(self._run(case)[0])

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives of a case's cost."""
        slopes = zip(TERMS, self._run(case)[1], strict=True)
        return {term: np.asarray(slope)[..., self._slice(case, term)] for term, slope in slopes}
