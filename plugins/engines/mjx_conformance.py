"""MJX in the conformance set: all cases of equal options in one model, differentiated through the converged solver."""

from __future__ import annotations

import contextlib
import functools
import re
from typing import Any

import jax
import mujoco
import numpy as np
from bench.plugins.engines.mujoco_conformance import place

from bench.engines.conformance import cases
from bench.plugins import mjx_solver

jax.config.update("jax_enable_x64", True)
APART = 20.0
"""Distance of two cases in a model [m]."""


class Engine:
    """Cases that share a group are compiled together. ``is_implicit`` differentiates through the converged solver."""

    versions = {"mujoco-mjx": mujoco.__version__, "jax": jax.__version__}
    differs = dict.fromkeys(("connect", "connect_fast", "weld"), "MJX has no velocity product J-dot v in these rows")

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
            for name in ("timestep", "integrator", "cone", "impratio", "tolerance", "iterations", "ls_iterations"):
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
    def _step(self) -> Any:
        """Return the compiled function of a vector and a step's inputs: next (q, v), warm start, and the vector's product."""
        mjx = mjx_solver.library()
        model, data = mjx.put_model(self._model), mjx.make_data(self._model)
        data = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, data)

        def step(q: Any, v: Any, u: Any, p: Any, warm: Any) -> Any:
            changed: dict[str, Any] = {}
            for value, case, (owner, field, index) in zip(p, self._members.values(), self._places, strict=True):
                name = f"opt.{field}" if owner is self._model.opt else field
                old = getattr(model.opt if owner is self._model.opt else model, field)
                changed[name] = changed.get(name, jax.numpy.asarray(old, float)).at[index].add(value - case.parameter)
            with self._solver():
                after = mjx.step(model.tree_replace(changed), data.replace(qpos=q, qvel=v, ctrl=u, qacc_warmstart=warm))
            return (after.qpos, after.qvel), jax.lax.stop_gradient(after.qacc)

        def pull(up: Any, *at: Any) -> Any:
            after, back, warm = jax.vjp(lambda *inputs: step(*inputs, at[-1]), *at[:-1], has_aux=True)
            return after, warm, back(up)

        return jax.jit(pull)

    def _slice(self, case: Any, field: str) -> slice:
        """Return the part of all cases' values that is a case's."""
        sizes = [len(np.atleast_1d(getattr(other, field).T)) for other in self._members.values()]
        number = list(self._members).index(case.name)
        return slice(sum(sizes[:number]), sum(sizes[: number + 1]))

    def path(self, case: Any) -> list[Any]:
        """Return what each step starts from, (q, v, u, p, warm start), and last (q, v), with all other cases as stored."""
        members = (self._members | {case.name: case}).values()
        q, v, p = (np.hstack([getattr(each, field) for each in members]) for field in ("qpos", "qvel", "parameter"))
        q, warm, steps = q + self._shift, 0.0 * v, []
        for u in np.hstack([each.controls for each in members]):
            steps.append((q, v, u, p, warm))
            (q, v), warm, _ = self._step((0.0 * q, 0.0 * v), *steps[-1])
        return [*steps, (q, v)]

    def rollout(self, case: Any) -> float:
        """Return the cost of a case."""
        q, v = self.path(case)[-1]
        own = self._slice(case, "qpos")
        return float(case.cost((q - self._shift)[own], v[self._slice(case, "qvel")]))

    def gradient(self, case: Any) -> dict[str, np.ndarray]:
        """Return the derivatives of a case's cost."""
        *steps, (q, v) = self.path(case)
        of_q, of_v, of_u, of_p = (self._slice(case, field) for field in ("qpos", "qvel", "controls", "parameter"))
        up = [np.zeros(len(q)), np.zeros(len(v))]
        up[0][of_q], up[1][of_v] = case.data["weights"]["qpos"], case.data["weights"]["qvel"]
        by_control, by_parameter = [], 0.0
        for step in reversed(steps):
            *up, by_u, by_p = self._step(tuple(up), *step)[2]
            by_control.insert(0, by_u[of_u])
            by_parameter = by_parameter + by_p[of_p]
        found = {"qpos": up[0][of_q], "qvel": up[1][of_v], "controls": by_control, "parameter": by_parameter}
        return {term: np.asarray(value) for term, value in found.items()}
