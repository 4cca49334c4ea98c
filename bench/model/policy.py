"""Policies that map observations to controls, and the scenes whose control law is such a policy."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from bench.errors import Unsupported
from bench.host import registry
from bench.host.identity import parse_identity
from bench.host.parameters import Plugin, build, param, parameters, remember
from bench.model.ops import Array, State
from bench.model.scene import MechanicalScene


@dataclass(frozen=True)
class Policy(Plugin):
    """A function from observations to controls whose parameters are theta.

    Theta is a vector: the arrays of :meth:`shapes`, flattened in that order (row-major).
    """

    kind: ClassVar[str] = "policies"

    @abstractmethod
    def shapes(self, n_inputs: int, n_outputs: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the parameter arrays by name."""

    @abstractmethod
    def initial(self, n_inputs: int, n_outputs: int) -> np.ndarray:
        """Return the initial theta, ``(d,)``; the same at every call."""

    @abstractmethod
    def act(self, xp: Any, theta: Array, observations: Array) -> Array:
        """Return the controls ``(n_outputs, B)`` at ``observations (n_inputs, B)``.

        ``theta`` is ``(d, 1)``, shared by all columns, or ``(d, B)``.
        """

    def size(self, n_inputs: int, n_outputs: int) -> int:
        """Return d, the length of theta."""
        return sum(math.prod(shape) for shape in self.shapes(n_inputs, n_outputs).values())

    def arrays(self, xp: Any, theta: Array, n_inputs: int, n_outputs: int) -> dict[str, Array]:
        """Return theta ``(d, K)`` as arrays by name, each of its shape with a last axis of length K."""
        result, at = {}, 0
        for name, shape in self.shapes(n_inputs, n_outputs).items():
            count = math.prod(shape)
            result[name] = xp.reshape(theta[at : at + count], (*shape, theta.shape[1]))
            at += count
        return result


def affine(xp: Any, weight: Array, bias: Array, x: Array) -> Array:
    """Return weight x + bias, ``(m, B)``, for ``weight (m, n, K)``, ``bias (m, K)`` and ``x (n, B)``; K is 1 or B.

    A weight that all columns share is one matrix product.
    """
    product = weight[:, :, 0] @ x if weight.shape[2] == 1 else xp.sum(weight * x[None], axis=1)
    return product + bias


@remember
def policy_of(identity: str) -> Policy:
    """Return the policy of an identity string; raises :class:`UserError` if invalid.

    ``mlp[hidden=[32,16]]`` is ``mlp[hidden=32x16]``, and ``mlp[hidden=32]`` has one hidden layer.
    """
    name, given = parse_identity(identity)
    plugin = registry.usable("policies", name)
    values = {key: "x".join(map(str, value)) if isinstance(value, list) else value for key, value in given.items()}
    strings = {key for key, parameter in parameters(plugin).items() if parameter.type is str}
    return cast(Policy, build(plugin, {key: str(v) if key in strings else v for key, v in values.items()}))


@dataclass(frozen=True)
class PolicyScene(MechanicalScene):
    """A role: the controls are a :class:`Policy` of observations, u_t = pi(theta, o(x_t)) + sigma w_t.

    Theta holds the policy's parameters. The scene's own noise, if ``exogenous`` is not 0, decides the start of each
    rollout, and J is the mean over starts too. One step of ``dt`` is a control step, made of ``substeps`` steps of the
    integrator. After :meth:`has_ended` the state no longer moves, and :meth:`stage_cost` should be 0 there.
    """

    n_observations: ClassVar[int]

    noise: str = param("action", "whether noise is on the actions or on theta", choices=("action", "parameter"))
    horizon: int = param(100, "number of control steps", "steps", positive=True)
    dt: float = param(0.01, "length of a control step", "s", positive=True)
    policy: str = param("linear", "policy, as name or name[parameter=value,...]")
    substeps: int = param(1, "steps of the integrator per control step", positive=True)

    def __post_init__(self) -> None:
        _ = self.plugin  # raises the error of an invalid policy

    @property
    def plugin(self) -> Policy:
        """The policy."""
        return policy_of(self.policy)

    @abstractmethod
    def observation(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the inputs of the policy, ``(n_observations, B)``, each of order 1."""

    def starting_state(self, xp: Any, theta: Array, e: Array | None) -> State:
        """Return the random state at t = 0, or the initial state of a scene without random starts."""
        return self.random_start(xp, e) if self.exogenous else self.initial_state(xp, theta)

    def random_start(self, xp: Any, e: Array) -> State:
        """Return the states at t = 0 from standard normal ``e (exogenous, B)``; needed only if ``exogenous`` is not 0."""
        raise Unsupported(f"scene {self.name} has exogenous={self.exogenous} and defines no random_start")

    def theta0(self) -> np.ndarray:
        """Return the policy's initial parameters, ``(d,)``."""
        return self.plugin.initial(self.n_observations, self.n_u)

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return the controls of the policy, ``(n_u, B)``."""
        return self.plugin.act(xp, theta, self.observation(xp, q, v))

    def controls_of(self, xp: Any, action: Array) -> Array:
        """Return the controls of a trained network's actions ``(n_u, B)``, which have no bound: the actions themselves."""
        return action

    def pullback(
        self, theta: np.ndarray, states: np.ndarray, weights: np.ndarray, by_theta: bool = True
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the derivatives of sum(weights * controls) by theta and state, by JAX in float64; None without JAX.

        They cost a few evaluations of the policy, whatever d is.
        """
        if not registry.installed("jax"):
            return None
        import jax

        jax.config.update("jax_enable_x64", True)
        total, by_state = _product(self, by_theta)(theta, states, weights)
        return np.asarray(total), np.asarray(by_state)


def uniform(xp: Any, e: Array) -> Array:
    """Return numbers uniform in (0, 1), ``(n, B)``, from standard normal ``e (2 n, B)``.

    (e1^2 + e2^2) / 2 is exponentially distributed (Box and Muller 1958), so exp of its negative is uniform.
    """
    half = e.shape[0] // 2
    return xp.exp(-0.5 * (e[:half] ** 2 + e[half:] ** 2))


@remember
def _product(scene: PolicyScene, by_theta: bool) -> Callable[..., Any]:
    """Return the vector-Jacobian product of :meth:`PolicyScene.pullback`, compiled by JAX for each shape."""
    import jax
    import jax.numpy as jnp

    def product(theta: Array, states: Array, weights: Array) -> Any:
        def step(total: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
            x, weight = at

            def controls(theta: Array, x: Array) -> Array:
                return scene.feedback(jnp, theta, *scene.split(x))

            if not by_theta:
                return total, jax.vjp(lambda x: controls(theta, x), x)[1](weight)[0]
            by_parameter, by_state = jax.vjp(controls, theta, x)[1](weight)
            return total + by_parameter, by_state

        # step by step, since the derivatives of all steps by theta would take T times the memory
        steps = (jnp.moveaxis(states, 1, 0), jnp.moveaxis(weights, 1, 0))
        total, by_state = jax.lax.scan(step, jnp.zeros_like(theta), steps)
        return total, jnp.moveaxis(by_state, 0, 1)

    return jax.jit(product)
