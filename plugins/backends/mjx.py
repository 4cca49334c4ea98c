"""MJX: the scene's MJCF twin in JAX, differentiated by JAX through MuJoCo's step."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.model import Array, Backend, Ops, Problem, Program, Rollout, State, param, rollout

from .. import mjcf
from .jax import Jax, JaxProblem

FORWARD_UP_TO = 8
"""Maximum length of theta for forward mode: reverse mode costs as much as this number of directions."""
LARGEST = 1e10
"""Maximum absolute value in a state; MuJoCo stops a rollout at larger values (``mjMAXVAL``)."""


@dataclass(frozen=True)
class Mjx(Jax):
    """Gradients: exact derivative of MJX's steps, forward or reverse mode; float64 or float32.

    Steps the scene's MJCF twin with MJX's own integrator and contact solver, compiled by XLA. The whole model is
    traced: stiffness, damping, masses, sizes and time step change without recompilation. Costs, policy and noise are
    the scene's.
    """

    name = "mjx"
    requires: ClassVar[tuple[str, ...]] = ("jax", "mujoco", "mujoco.mjx=mujoco-mjx")
    provides = Backend.provides | {"physics"}
    reference_rank: ClassVar[int | None] = None

    mode: str = param("auto", "mode of differentiation; auto: the cheaper mode", choices=("auto", "reverse", "forward"))
    impedance: float = param(
        1e-4, "share of other forces that a contact cancels; at 0 it is a spring", low=1e-4, high=0.9999
    )
    integrator: str = param("euler", "MJX's integrator", choices=("euler", "implicitfast", "rk4"))
    solver: str = param("newton", "MJX's constraint solver", choices=("newton", "cg"))
    cone: str = param("pyramidal", "friction cone", choices=("pyramidal", "elliptic"))
    iterations: int = param(1, "maximum iterations of the constraint solver; 1 is exact for springs", positive=True)
    ls_iterations: int = param(4, "maximum iterations of the solver's line search", positive=True)
    lean: bool = param(True, "switch off all engine features that the scene does not use")

    def compile(self, program: Program) -> Problem:
        """Return the twin's steps as jitted functions, compiled at the first call with each batch shape."""
        ops = self.ops()
        return MjxProblem(MjxProgram(rollout(program), self), ops, self.dtype, self._direction(program))

    def unsupported_reason(self, program: Program) -> str | None:
        """Return why the program cannot run: it has no twin, or MJX cannot differentiate it; or None."""
        reason = mjcf.unsupported_reason(self, program)
        if reason is None and self.mode == "reverse" and self.iterations > 1:
            return (
                f"MJX's solver has no reverse mode with iterations={self.iterations}: use mode=forward or iterations=1"
            )
        if reason is None and self.cone == "elliptic" and mjcf.has_friction(program):
            return "MJX's derivatives are NaN with elliptic friction cones: use cone=pyramidal"
        return reason

    def _direction(self, program: Program) -> str:
        if self.mode != "auto":
            return self.mode
        return "reverse" if self.iterations == 1 and program.dim > FORWARD_UP_TO else "forward"


class MjxProblem(JaxProblem):
    """A program stepped by MJX, in smaller blocks, since padding columns are expensive."""

    grain = 16


class MjxProgram(Rollout):
    """A program stepped by MJX. Its parameters are the scene's, followed by all numbers of the MJX model."""

    def __init__(self, program: Rollout, backend: Mjx) -> None:
        import jax

        mjx = _library()
        super().__init__(program.scene, program.contact, program.integrator, program.decision)
        model = mjcf.build(backend, program)
        leaves, self._tree = jax.tree.flatten(mjx.put_model(model))
        self._leaves = [np.asarray(leaf) for leaf in leaves]
        self._model: Any = None
        self._data = mjx.make_data(model)
        options = tuple(getattr(backend, name) for name in ("integrator", "solver", "cone", "lean"))
        self._settings = (*options, backend.iterations, backend.ls_iterations, int(model.opt.disableflags))

    @property
    def structure(self) -> tuple[Any, ...]:
        """A key: the program's structure, the engine's settings, and the parts of the model that cannot be traced."""
        # only floats are traced: any other leaf is compiled in and must be part of the key
        fixed = tuple(leaf.tobytes() for leaf in self._leaves if leaf.dtype.kind != "f")
        return (*super().structure, self._settings, self._tree, fixed)

    def parameters(self) -> np.ndarray:
        """Return the float parameters of the plugins, followed by the floats of the MJX model, ``(p,)``."""
        return np.concatenate(
            [super().parameters(), *(leaf.ravel() for leaf in self._leaves if leaf.dtype.kind == "f")]
        )

    def bind(self, parameters: Any) -> Program:
        """Return a copy of this program and its model with the values ``parameters (p,)``."""
        import jax
        import jax.numpy as jnp

        start = super().parameters().size
        bound = super().bind(parameters[:start])
        assert isinstance(bound, MjxProgram)
        leaves: list[Any] = []
        for leaf in self._leaves:
            if leaf.dtype.kind == "f":
                leaves.append(parameters[start : start + leaf.size].reshape(leaf.shape))
                start += leaf.size
            else:
                leaves.append(jnp.asarray(leaf))
        bound._model = jax.tree.unflatten(self._tree, leaves)
        return bound

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the state after one MJX step per column; NaN beyond MuJoCo's limit, at which MuJoCo would stop."""
        import jax
        import jax.numpy as jnp

        mjx, kind = _library(), state.q.dtype
        data = jax.tree.map(lambda leaf: leaf.astype(kind) if leaf.dtype.kind == "f" else leaf, self._data)

        def column(q: Array, v: Array, u: Array) -> State:
            after = mjx.step(self._model, data.replace(qpos=q, qvel=v, ctrl=u))
            return State(after.qpos, after.qvel)

        # MJX creates numbers in JAX's default precision
        with jax.enable_x64(kind == np.float64):
            after = jax.vmap(column, in_axes=-1, out_axes=-1)(state.q, state.v, u)
            largest = jnp.maximum(jnp.abs(after.q).max(axis=0), jnp.abs(after.v).max(axis=0))
            factor = jnp.where(largest <= LARGEST, 1.0, jnp.nan).astype(kind)  # a factor makes the gradient NaN too
            return State(after.q * factor, after.v * factor)


def _library() -> Any:
    """Return ``mujoco.mjx`` without printing its messages about missing optional parts."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx
