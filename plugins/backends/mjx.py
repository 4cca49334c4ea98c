"""MJX: the scene's MJCF twin in JAX, differentiated by JAX through MuJoCo's step."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import (
    Array,
    Backend,
    EngineTwin,
    Ops,
    Problem,
    Program,
    Rollout,
    State,
    Unsupported,
    param,
    rollout,
)

from .. import mjcf, mjx_solver
from .jax import Jax, JaxProblem

_REMARKED: set[tuple[str, str, str]] = set()
"""Scenes, files and cones whose remarks were printed."""


@dataclass(frozen=True)
class Mjx(Jax):
    """Gradients: derivative of MJX's steps with one solver iteration or the converged solver; float64 or float32.

    Steps the scene's MJCF twin with MJX's own integrator and contact solver, compiled by XLA. The whole model is
    traced: stiffness, damping, masses, sizes and time step change without recompilation. Costs, policy and noise are
    the scene's.
    """

    name = "mjx"
    uses = (mjcf, mjx_solver)
    requires = ("jax", "mujoco", "mujoco.mjx=mujoco-mjx")
    provides = Backend.provides | {"physics"}
    reference_rank = None

    mode: str = param("auto", "mode of differentiation; auto: the cheaper mode", choices=("auto", "reverse", "forward"))
    impedance: float = param(
        1e-4, "share of other forces that a contact cancels; at 0 it is a spring", low=1e-4, high=0.9999
    )
    integrator: str = param("euler", "MJX's integrator", choices=("euler", "implicitfast", "rk4"))
    solver: str = param("newton", "MJX's constraint solver", choices=("newton", "cg"))
    cone: str = param(
        "pyramidal", "friction cone; a file with elliptic cones needs elliptic", choices=("pyramidal", "elliptic")
    )
    derivative: str = param(
        "auto",
        "through the iterations of the constraint solver, or implicit: through its converged solution; auto: implicit for iterations > 1",
        choices=("auto", "implicit", "unrolled"),
    )
    iterations: int = param(1, "maximum iterations of the constraint solver; 1 is exact for springs", positive=True)
    ls_iterations: int = param(4, "maximum iterations of the solver's line search", positive=True)
    lean: bool = param(True, "switch off all engine features that the scene does not use")

    def compile(self, program: Program) -> Problem:
        ops = self.ops()
        return MjxProblem(MjxProgram(rollout(program), self), ops, self.dtype, self._direction(program))

    def own_refusal(self, program: Program) -> str | None:
        """Return why the program cannot run: it has no twin, or MJX cannot differentiate it; or None."""
        if reason := mjcf.refusal(self, program):
            return reason
        scene = program.scene
        is_file = isinstance(scene, EngineTwin) and scene.model_file() is not None
        if is_file and self.iterations == 1 and not self.is_implicit:
            return f"one solver iteration is exact for springs only: use {self.name}[iterations=20]"
        if self.cone == "elliptic" and (reason := self._elliptic_reason(mjcf.build(self, program))):
            return reason
        if not self.is_implicit and self.mode == "reverse" and self.iterations > 1:
            return (
                f"MJX's solver has no reverse mode with iterations={self.iterations} and derivative=unrolled: use "
                "derivative=implicit, mode=forward or iterations=1"
            )
        key = (scene.name, getattr(scene, "file", ""), self.cone)
        if key not in _REMARKED:
            _REMARKED.add(key)
            for remark in self.remarks(program):
                print(f"{scene.name}: {remark}", file=sys.stderr)
        return None

    def remarks(self, program: Program) -> list[str]:
        """Return in what MJX's physics of the program's model differ from the C engine's; known before anything runs."""
        return mjcf.mjx_remarks(mjcf.build(self, program))

    def _elliptic_reason(self, model: Any) -> str | None:
        """Return why contacts with elliptic cones exclude the model, or None."""
        mjx_solver.library()
        from mujoco.mjx._src.collision_driver import make_condim

        dimensions = make_condim(model)
        if 1 in dimensions:
            return "MJX has no contacts without friction beside elliptic cones: use pyramidal cones"
        if len(dimensions) and not self.is_implicit:
            return (
                "MJX's derivatives through the iterations of its solver are NaN with elliptic friction cones "
                f"(iterations={self.iterations}, derivative={self.derivative}): use derivative=implicit and iterations=100, "
                "or pyramidal cones"
            )
        return None

    @property
    def is_implicit(self) -> bool:
        """Whether the derivative is that of the solver's converged solution."""
        return self.derivative == "implicit" or (self.derivative == "auto" and self.iterations > 1)

    def solver_residual(self, problem: Problem, w: np.ndarray) -> float:
        """Return the largest relative residual of the constraint solver along rollouts from theta0 with noise ``(n_w, B)``.

        It is compared with the forces of a step. NaN if a rollout fails. At most 16 columns of the noise are used.
        """
        assert isinstance(problem, MjxProblem)
        return problem.solver_residual(w)

    def _direction(self, program: Program) -> str:
        if self.mode != "auto":
            return self.mode
        has_reverse = self.iterations == 1 or self.is_implicit
        # maximum length of theta for forward mode: reverse mode costs as much as this number of directions
        return "reverse" if has_reverse and program.dim > 8 else "forward"


class MjxProblem(JaxProblem):
    """A program stepped by MJX. A processor has two compiled shapes: one column, for small batches, and 16."""

    def _blocks(
        self, function: Callable[..., np.ndarray], theta: np.ndarray, w: np.ndarray, lead: tuple[int, ...]
    ) -> np.ndarray:
        is_cpu = self.device == "cpu"
        # maximum number of columns that run one by one, since padding columns are expensive
        self.grain = 1 if w.shape[1] <= (4 if is_cpu else 1) else 16
        if is_cpu:
            self.block = self.least = self.grain
        return super()._blocks(function, theta, w, lead)

    def engine_contacts(self) -> mjcf.Contacts:
        """Return the contacts of the twin's model, by the C engine's collisions."""
        assert isinstance(self.program, MjxProgram)
        return mjcf.Contacts(self.program.source)

    def solver_residual(self, w: np.ndarray) -> float:
        """Return the largest relative residual of the constraint solver along rollouts from theta0 with ``w (n_w, B)``."""
        theta = self.program.theta0.reshape(self.dim, 1)
        # rollouts in which the residual of the constraint solver is measured
        (residuals,) = self._parts(self._residuals, theta, w[:, :16])
        return float(residuals.max())

    def _residuals(self, parameters: Array, theta: Array, w: Array) -> tuple[Array]:
        """Return the relative residual of each step's constraint solver, ``(horizon, B)``."""
        return (self._scanned(parameters, theta, w, MjxProgram.residual)[1],)


class MjxProgram(Rollout):
    """A program stepped by MJX. Its parameters are the scene's, followed by all numbers of the MJX model."""

    def __init__(self, program: Rollout, backend: Mjx) -> None:
        import jax

        mjx = mjx_solver.library()
        super().__init__(program.scene, program.contact, program.integrator, program.decision)
        self.source = model = mjcf.build(backend, program)
        try:
            leaves, self._tree = jax.tree.flatten(mjx.put_model(model))
        except NotImplementedError as error:
            raise Unsupported(f"MJX does not run this model: {error}") from None
        self._leaves = [np.asarray(leaf) for leaf in leaves]
        self._model: Any = None
        self._data = mjx.make_data(model)
        self._solver = mjx_solver.implicit if backend.is_implicit else contextlib.nullcontext
        options = tuple(getattr(backend, name) for name in ("integrator", "solver", "cone", "lean", "is_implicit"))
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
        """Return the state after ``substeps`` MJX steps per column, compiled once, or the same state after the end."""
        import jax

        n = self.scene.substeps
        if n == 1:
            after = self._advanced(state, u)
        else:
            after, _ = jax.lax.scan(lambda at, _: (self._advanced(at, u), None), state, length=n)
        return self.stopped(ops.xp, state, after)

    def _advanced(self, state: State, u: Array) -> State:
        """Return the state after one MJX step per column; NaN beyond MuJoCo's limit, at which MuJoCo would stop."""
        import jax.numpy as jnp

        def column(data: Any) -> State:
            after = mjx_solver.library().step(self._model, data)
            return State(after.qpos, after.qvel)

        after: State = self._columns(column, state, u)
        largest = jnp.maximum(jnp.abs(after.q).max(axis=0), jnp.abs(after.v).max(axis=0))
        # maximum absolute value in a state; MuJoCo stops a rollout at larger values (mjMAXVAL)
        factor = jnp.where(largest <= 1e10, 1.0, jnp.nan).astype(after.q.dtype)  # makes the gradient NaN too
        return State(after.q * factor, after.v * factor)

    def residual(self, state: State, u: Array) -> Array:
        """Return the relative residual of the constraint solver in one step per column, ``(B,)``."""

        def column(data: Any) -> Array:
            after = mjx_solver.library().forward(self._model, data)
            return mjx_solver.relative_residual(self._model, after)

        return self._columns(column, state, u)

    def contacts(self, state: State) -> tuple[Array, Array, Array]:
        """Return, per column ``(B,)``, closed contacts, largest penetration [m] and force, which is NaN: not computed."""
        import jax.numpy as jnp

        def column(data: Any) -> Any:
            return mjx_solver.library().fwd_position(self._model, data)._impl.contact.dist

        nothing = jnp.zeros((self._model.nu, state.q.shape[1]), state.q.dtype)
        gap = self._columns(column, state, nothing)
        return (
            (gap < 0).sum(axis=0).astype(gap.dtype),
            jnp.maximum(-gap, 0.0).max(axis=0, initial=0.0),
            jnp.nan * gap[0],
        )

    def _columns(self, function: Callable[[Any], Any], state: State, u: Array) -> Any:
        """Return ``function`` of the MJX data of each column, stacked along the last axis."""
        import jax

        kind = state.q.dtype
        data = jax.tree.map(lambda leaf: leaf.astype(kind) if leaf.dtype.kind == "f" else leaf, self._data)

        def column(q: Array, v: Array, u: Array) -> Any:
            return function(data.replace(qpos=q, qvel=v, ctrl=u))

        # MJX creates numbers in JAX's default precision
        with jax.enable_x64(kind == np.float64), self._solver():
            if state.q.shape[1] == 1:  # without vmap, whose loops compute both branches
                after = column(state.q[:, 0], state.v[:, 0], u[:, 0])
                return jax.tree.map(lambda leaf: leaf[..., None], after)
            return jax.vmap(column, in_axes=-1, out_axes=-1)(state.q, state.v, u)
