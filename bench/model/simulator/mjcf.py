"""A user's MuJoCo model as a cost of theta, run by MuJoCo (C) or MJX. Free joints and quaternions are supported.

The user's functions of (model, data) work with both engines: ``start`` returns fields of the data by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import UserError, unknown

ENGINES = {"mujoco": "mujoco", "mjx": "mujoco-mjx"}
"""The engines and the distributions that provide them."""
STEP = 1e-6
"""Step of the finite differences, in the units of the state, control or theta."""


class Mjcf:
    """A rollout of a model: ``sim(theta)`` is its cost, ``sim.gradient(theta)`` the engine's derivative, ``(d,)``.

    ``model`` is an MJCF string or a file. ``start(model, data, theta)`` returns the fields to set before the first
    step, such as ``{"qvel": theta}``. ``cost(model, data)`` returns a number, given the data after ``steps`` steps and
    a forward pass. ``control(model, data, theta, t)``, if given, returns the controls ``(nu,)`` of step t.

    ``mujoco`` chains finite differences of single steps in the tangent space of the state, so that nq and nv may
    differ. ``mjx`` differentiates in forward mode, the only mode that the constraint solver's loops allow. Raises
    :class:`bench.UserError` if the engine is not installed or the model cannot be read.
    """

    def __init__(
        self,
        model: str | Path,
        start: Callable[..., Mapping[str, Any]],
        cost: Callable[..., Any],
        steps: int,
        engine: str = "mujoco",
        control: Callable[..., Any] | None = None,
    ) -> None:
        if engine not in ENGINES:
            raise unknown("engine", engine, ENGINES)
        try:
            import mujoco
        except ImportError:
            raise UserError(f"engine={engine} is not installed: pip install {ENGINES[engine]}") from None
        text = str(model)
        try:
            if "<mujoco" in text:
                self.model = mujoco.MjModel.from_xml_string(text)
            else:
                self.model = mujoco.MjModel.from_xml_path(text)
        except ValueError as error:
            raise UserError(f"the model cannot be read: {error}") from None
        self._start, self._cost, self._control, self.steps = start, cost, control, steps
        self._mujoco, self._data, self._probe = mujoco, mujoco.MjData(self.model), mujoco.MjData(self.model)
        self._engine = _Mjx(self) if engine == "mjx" else None
        self.__name__ = self.__qualname__ = (
            f"{engine} model, nq={self.model.nq}, nv={self.model.nv}, nu={self.model.nu}"
        )
        self.__module__ = ""

    def __call__(self, theta: Any) -> float:
        """Return the cost of the rollout from theta, ``(d,)``."""
        if self._engine is not None:
            return self._engine.value(theta)
        data = self._reset(self._data, theta)
        for t in range(self.steps):
            self._set_control(data, theta, t)
            self._mujoco.mj_step(self.model, data)
        return self._final_cost(data)

    def gradient(self, theta: Any) -> np.ndarray:
        """Return the derivative of the cost with respect to theta, ``(d,)``."""
        if self._engine is not None:
            return self._engine.slope(theta)
        theta = np.asarray(theta, dtype=np.float64)
        data, size = self._reset(self._data, theta), 2 * self.model.nv + self.model.na
        slopes = self._initial_slopes(theta)
        a, b = np.zeros((size, size)), np.zeros((size, self.model.nu))
        for t in range(self.steps):
            self._set_control(data, theta, t)
            control = self._control_slopes(data, theta, t, slopes)
            self._mujoco.mj_copyData(self._probe, self.model, data)
            self._mujoco.mjd_transitionFD(self.model, self._probe, STEP, True, a, b, None, None)
            slopes = a @ slopes + b @ control
            self._mujoco.mj_step(self.model, data)
        last = [self._final_cost(self._displaced(data, i, h)) for i in range(size) for h in (STEP, -STEP)]
        return np.asarray((np.array(last[::2]) - np.array(last[1::2])) / (2 * STEP) @ slopes)

    # ------------------------------------------------------------------------------------------- the C engine

    def _reset(self, data: Any, theta: Any) -> Any:
        self._mujoco.mj_resetData(self.model, data)
        for name, value in self._fields(data, theta).items():
            getattr(data, name)[:] = value
        return data

    def _fields(self, data: Any, theta: Any) -> Mapping[str, Any]:
        """Return the fields that ``start`` sets."""
        fields = self._start(self.model, data, theta)
        if not isinstance(fields, Mapping):
            raise UserError(
                f"start returned {fields!r}: it must return fields of the data by name, such as {{'qvel': theta}}, and not set them itself"
            )
        for name in fields:
            if not hasattr(data, name):
                raise unknown("field of the data", name, [field for field in dir(data) if not field.startswith("_")])
        return fields

    def _set_control(self, data: Any, theta: Any, t: int) -> None:
        if self._control is not None:
            # update body positions to the current state
            self._mujoco.mj_forward(self.model, data)
            data.ctrl[:] = self._control(self.model, data, theta, t)

    def _final_cost(self, data: Any) -> float:
        self._mujoco.mj_forward(self.model, data)
        return float(self._cost(self.model, data))

    def _initial_slopes(self, theta: np.ndarray) -> np.ndarray:
        """Return d initial state / d theta in the state's tangent space, ``(2 nv + na, d)``."""
        columns = []
        for i in range(theta.size):
            states = []
            for h in (STEP, -STEP):
                at = theta.copy()
                at[i] += h
                data = self._reset(self._probe, at)
                states.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
            up, down = states
            difference = np.zeros(self.model.nv)
            self._mujoco.mj_differentiatePos(self.model, difference, 2 * STEP, down[0], up[0])
            columns.append(np.concatenate([difference, *((up[k] - down[k]) / (2 * STEP) for k in (1, 2))]))
        return np.stack(columns, axis=1)

    def _displaced(self, data: Any, index: int, by: float) -> Any:
        """Return a copy of the data, displaced by ``by`` along one direction of the state's tangent space."""
        nv, probe = self.model.nv, self._probe
        self._mujoco.mj_copyData(probe, self.model, data)
        if index < nv:
            direction = np.zeros(nv)
            direction[index] = 1.0
            self._mujoco.mj_integratePos(self.model, probe.qpos, direction, by)
        elif index < 2 * nv:
            probe.qvel[index - nv] += by
        else:
            probe.act[index - 2 * nv] += by
        return probe

    def _control_slopes(self, data: Any, theta: np.ndarray, t: int, slopes: np.ndarray) -> np.ndarray:
        """Return the total derivative of the controls with respect to theta, also through the state, ``(nu, d)``."""
        if self._control is None:
            return np.zeros((self.model.nu, theta.size))

        def control(at: Any, theta: np.ndarray) -> np.ndarray:
            self._mujoco.mj_forward(self.model, at)
            return np.array(self._control(self.model, at, theta, t), dtype=np.float64)  # type: ignore[misc]

        direct = [control(data, theta + h * row) for row in np.eye(theta.size) for h in (STEP, -STEP)]
        indirect = [control(self._displaced(data, i, h), theta) for i in range(len(slopes)) for h in (STEP, -STEP)]
        by_theta = (np.array(direct[::2]) - np.array(direct[1::2])).T / (2 * STEP)
        return np.asarray(by_theta + (np.array(indirect[::2]) - np.array(indirect[1::2])).T / (2 * STEP) @ slopes)


class _Mjx:
    """The rollout of an :class:`Mjcf` in MJX, compiled by JAX."""

    def __init__(self, simulator: Mjcf) -> None:
        try:
            import jax
            from mujoco import mjx
        except ImportError:
            raise UserError("engine=mjx is not installed: pip install mujoco-mjx") from None
        model = mjx.put_model(simulator.model)

        def rollout(theta: Any) -> Any:
            data = _promoted(mjx.make_data(model))
            data = data.replace(**simulator._fields(data, theta))

            def step(data: Any, t: Any) -> Any:
                if simulator._control is not None:
                    data = mjx.forward(model, data)
                    data = data.replace(ctrl=simulator._control(model, data, theta, t))
                return mjx.step(model, data), None

            last, _ = jax.lax.scan(step, data, jax.numpy.arange(simulator.steps))
            return simulator._cost(model, mjx.forward(model, last))

        self._value, self._slope, self._asarray = jax.jit(rollout), jax.jit(jax.jacfwd(rollout)), jax.numpy.asarray

    def value(self, theta: Any) -> float:
        return float(self._value(self._asarray(theta, dtype=float)))

    def slope(self, theta: Any) -> np.ndarray:
        return np.asarray(self._slope(self._asarray(theta, dtype=float)), dtype=np.float64)


def _promoted(data: Any) -> Any:
    """Return MJX data with all floats in JAX's default precision, since MJX may use a lower one."""
    import jax

    wide = jax.numpy.zeros(()).dtype

    def promoted(leaf: Any) -> Any:
        return leaf.astype(wide) if jax.numpy.issubdtype(getattr(leaf, "dtype", int), jax.numpy.floating) else leaf

    return jax.tree.map(promoted, data)
