"""JAX: reverse-mode (or forward-mode) differentiation through lax.scan, compiled by XLA."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.model import (
    Array,
    Backend,
    Jacobians,
    LoopOps,
    Ops,
    Problem,
    Program,
    Rollout,
    State,
    Trajectory,
    difference,
    n_changes,
    param,
    retract,
    rollout,
)

from . import rows
from .compiling import compiled


@dataclass(frozen=True)
class Jax(Backend):
    """Gradients: exact derivative of the program, reverse mode by default; float64 or float32; no root finder."""

    name = "jax"
    requires: ClassVar[tuple[str, ...]] = ("jax",)
    provides = Backend.provides | {"surrogate"}
    compiles = True
    reference_rank: ClassVar[int | None] = 0

    mode: str = param("reverse", "direction of differentiation", choices=("reverse", "forward"))

    def compile(self, program: Program) -> Problem:
        return JaxProblem(program, self.ops(), self.dtype, self.mode)

    def ops(self) -> Ops:
        """Return the operations for the model code."""
        use_double_precision()
        return JaxOps()


def use_double_precision() -> None:
    """Enable float64 in JAX, which otherwise computes in float32."""
    import jax

    jax.config.update("jax_enable_x64", True)


class JaxOps(LoopOps):
    """Operations of jax.numpy with lax.scan and without ``root``."""

    def __init__(self) -> None:
        import jax.numpy

        super().__init__(jax.numpy)

    def scan(self, step: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """Return the last carry of :meth:`loop` over rows."""
        import jax

        leaves, tree = jax.tree.flatten(carry)
        slices, slice_tree = jax.tree.flatten(xs)

        def flat(*arguments: Array) -> list[Array]:
            state, x = arguments[: len(leaves)], arguments[len(leaves) :]
            return jax.tree.leaves(step(jax.tree.unflatten(tree, state), jax.tree.unflatten(slice_tree, x)))

        traced = jax.make_jaxpr(flat)(*leaves, *(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in slices))

        def body(state: list[Any], x: list[Any]) -> list[Any]:
            return rows.evaluate(traced.jaxpr, traced.consts, [*state, *x])

        last = self.loop(body, [rows.split(x) for x in leaves], [rows.split(x, axis=1) for x in slices], length)
        return jax.tree.unflatten(tree, [rows.join(x) for x in last])

    def loop(self, body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """Return the last carry. The backward pass stores only carries and recomputes each step."""
        return loop(body, carry, xs, length)


def loop(body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int, recomputes: bool = True) -> Any:
    """Return the last carry of ``carry = body(carry, x)`` by lax.scan.

    The backward pass stores only carries and recomputes each step, or else keeps the results of all operations.
    """
    import jax

    # within a scan XLA cannot merge the two evaluations, so common-subexpression elimination need not be prevented
    one = jax.checkpoint(body, prevent_cse=False) if recomputes else body
    return jax.lax.scan(lambda state, x: (one(state, x), None), carry, xs, length)[0]


def _numbers(program: Program) -> int:
    """Return an estimate of the numbers stored per rollout gradient: carries, controls, gradients, theta and noise."""
    stored = 2 * program.dim + program.n_noise
    if isinstance(program, Rollout):
        scene = program.scene
        stored += scene.horizon * (2 * scene.n_q + 2 + 2 * scene.n_u)
    return stored


class JaxProblem(Problem):
    """A program compiled once per batch shape. Float parameters are traced, so that new values need no compilation.

    Each block runs on one XLA thread and blocks run in parallel, which uses all cores without synchronisation at every
    step.
    """

    # a single column is compiled to other operations, whose last digit differs
    grain = 2
    variant: Any = None
    """What else distinguishes the executables of a subclass."""

    def __init__(self, program: Program, ops: Ops, dtype: str, mode: str) -> None:
        import jax

        super().__init__(program)
        self._ops, self._dtype, self._mode = ops, np.dtype(dtype), mode
        self._parameters = program.parameters().astype(self._dtype)
        self.device = str(jax.default_backend())
        if self.device == "cpu":
            self.fit_blocks(_numbers(program) * self._dtype.itemsize)
            if program.dim >= 1 << 14:
                # a column is a block's worth of work: theta, per column, and its derivative fit a core's cache, and
                # few columns need hardly any padding
                self.grain = self.block = self.least = 8

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call(self._cost, theta, w)

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call(self._cost_gradient, theta, w)

    def second_gradient(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the gradient by forward mode if this problem uses reverse mode, and the other way round, ``(d, B)``."""
        other = "reverse" if self._mode == "forward" else "forward"
        return JaxProblem(self.program, self._ops, self._dtype.name, other).grad(theta, w)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._call(self._score_function, theta, w)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        return Trajectory(*self._parts(self._trajectory, theta, w))

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and step Jacobians, by forward mode through each step and by changes of the state."""
        return Jacobians(*self._parts(self._linearised, theta, w))

    def _trajectory(self, parameters: Array, theta: Array, w: Array) -> tuple[Array, Array]:
        import jax.numpy as jnp

        last, (before, controls) = self._scanned(parameters, theta, w, lambda _, state, u: (jnp.concatenate(state), u))
        return jnp.concatenate([before, jnp.concatenate(last)[None]]), controls

    def _scanned(
        self, parameters: Array, theta: Array, w: Array, seen: Callable[[Any, State, Array], Any]
    ) -> tuple[State, Any]:
        """Return the last state, and what is ``seen`` in each step from the program, the state before and the control."""
        import jax

        program, theta, w = rollout(self.program.bind(parameters)).resolved(self._ops, theta, w)

        def advance(state: State, slices: Any) -> tuple[State, Any]:
            u = program.control(self._ops, theta, state, slices)
            return program.step(self._ops, state, u), seen(program, state, u)

        theta, first, scanned = program.start(self._ops, theta, w)
        last, along = jax.lax.scan(advance, first, scanned, program.scene.horizon)
        return last, along

    def _linearised(self, parameters: Array, theta: Array, w: Array) -> tuple[Array, Array, Array, Array]:
        import jax
        import jax.numpy as jnp

        states, controls = self._trajectory(parameters, theta, w)
        program, *_ = rollout(self.program.bind(parameters)).resolved(self._ops, theta, w)
        scene = program.scene
        still = jnp.zeros((n_changes(scene), theta.shape[1]), states.dtype)

        def derivatives(at: tuple[Array, Array, Array]) -> list[Array]:
            x, u, after = at

            def step(change: Array, u: Array) -> Array:
                moved = retract(scene, jnp, x, change)
                state = program.step(self._ops, scene.split(moved), u)
                return difference(scene, jnp, jnp.concatenate(state), after)

            def by(function: Callable[[Array], Array], point: Array) -> Array:
                basis = jnp.eye(len(point), dtype=point.dtype)[:, :, None] + jnp.zeros_like(point)
                return jax.vmap(lambda e: jax.jvp(function, (point,), (e,))[1], out_axes=1)(basis)

            return [by(lambda change: step(change, u), still), by(lambda u: step(still, u), u)]

        a, b = jax.lax.map(derivatives, (states[:-1], controls, states[1:]))
        return states, controls, a, b

    def _parts(self, function: Callable[..., Any], theta: np.ndarray, w: np.ndarray) -> list[np.ndarray]:
        theta = np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        return [np.asarray(part, dtype=np.float64) for part in self._run(function, theta, w)]

    def _call(self, function: Callable[..., Array], theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.asarray(self._run(function, theta, w), dtype=np.float64)

    def _run(self, function: Callable[..., Any], theta: np.ndarray, w: np.ndarray) -> Any:
        args = (self._parameters, theta.astype(self._dtype, copy=False), w.astype(self._dtype, copy=False))
        solver = type(self._ops) if self.program.needs_root else None
        what = (solver, self.variant, function.__name__, self._mode, self._dtype)
        key = (*what, self.program.structure, theta.shape, w.shape)
        executable = compiled(key, function, args, self._measured, self.compilations)
        self._charge(key, executable.seconds)
        return executable.call(*args)

    def _cost(self, parameters: Array, theta: Array, w: Array) -> Array:
        return self.program.bind(parameters).cost(self._ops, theta, w)

    def _cost_gradient(self, parameters: Array, theta: Array, w: Array) -> Array:
        def cost(full: Array) -> Array:
            return self._cost(parameters, full, w)

        return self._derivative(cost, theta, w.shape[1])

    def _score_function(self, parameters: Array, theta: Array, w: Array) -> Array:
        def log_probability(scored: Array) -> Array:
            return self.program.bind(parameters).log_probability(self._ops, theta, scored, w)

        return self._derivative(log_probability, theta, w.shape[1])

    def _derivative(self, function: Callable[[Array], Array], theta: Array, batch: int) -> Array:
        """Return the derivative of column b of ``function`` by column b of theta, ``(d, B)``; NaN for nonfinite values.

        Without this rule, a choice between NaN and a number would have the number's derivative.
        """
        import jax
        import jax.numpy as jnp

        full = jnp.broadcast_to(theta, (self.dim, batch))
        if self._mode == "reverse":
            result, back = jax.vjp(function, full)
            return jnp.where(jnp.isfinite(result), back(jnp.ones_like(result))[0], jnp.nan)
        basis = jnp.eye(self.dim, dtype=full.dtype)

        def along(direction: Array) -> Array:
            result, slope = jax.jvp(function, (full,), (jnp.broadcast_to(direction[:, None], full.shape),))
            return jnp.where(jnp.isfinite(result), slope, jnp.nan)

        return jax.vmap(along)(basis)
