"""Policies that map observations to controls, and the scenes whose control law is such a policy."""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np

from bench.errors import Unsupported
from bench.model import registry
from bench.model.contact import ContactLaw
from bench.model.identity import parse_identity
from bench.model.integrator import Integrator
from bench.model.ops import Array, LoopOps, Ops, State
from bench.model.parameters import Plugin, build, param, parameters, remember
from bench.model.program import OWN, Decision, Rollout
from bench.model.scene import MechanicalScene

FLOOR = 1e-5
"""Added to the variance of an observation that is normalised, so that a constant one does not divide by 0."""


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


class PolicyRollout(Rollout):
    """The program of a :class:`PolicyScene`: random starts, substeps, and rollouts that may end early."""

    scene: PolicyScene

    def __init__(
        self,
        scene: PolicyScene,
        contact: ContactLaw | None,
        integrator: Integrator | None,
        decision: Decision = OWN,
    ) -> None:
        super().__init__(scene, contact, integrator, decision)
        if scene.normalise and scene.moments is None:
            self.scene = dataclasses.replace(scene)
            object.__setattr__(self.scene, "moments", observed_moments(scene, contact, integrator))

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """The key of the computation graph, with the moments of the observations, which are compiled in."""
        return (*super().structure, *(part.tobytes() for part in self.scene.moments or ()))

    @property
    def exogenous(self) -> int:
        """Number of normal numbers of the random start, the last rows of w."""
        return self.scene.n_start

    @property
    def n_noise(self) -> int:
        """n_w: one number per action, or d, plus the numbers of the random start."""
        own = self.scene.controls * self.scene.n_u if self.action_noise else self.dim
        return own + self.exogenous

    def start(self, ops: Ops, theta: Array, w: Array) -> tuple[Array, State, tuple[Array, ...]]:
        """Return theta plus its noise, the random initial state, and the noise on the actions, ``(horizon, n_u, B)``."""
        scene, xp, n_own = self.scene, ops.xp, self.n_noise - self.exogenous
        scanned: tuple[Array, ...] = ()
        if self.action_noise:
            scanned = (xp.reshape(w[:n_own], (scene.horizon, scene.n_u, w.shape[1])),)
        else:
            theta = theta + scene.sigma * w[:n_own]
        state = scene.random_start(xp, w[n_own:]) if scene.n_start else scene.initial_state(xp, theta)
        return theta, State(*(xp.broadcast_to(part, (part.shape[0], w.shape[1])) for part in state)), scanned

    def step(self, ops: Ops, state: State, u: Array) -> State:
        """Return the state after ``substeps`` steps of the integrator under ``u (n_u, B)``; unchanged after the end."""
        after = state
        for _ in range(self.scene.substeps):
            after = self.substep(ops, after, u)
        return self.stopped(ops.xp, state, after)

    def substep(self, ops: Ops, state: State, u: Array) -> State:
        """Return the state after one step of the integrator."""
        return self.integrator.step(self.dynamics(ops), state, u, self.scene.dt / self.scene.substeps)


@dataclass(frozen=True)
class PolicyScene(MechanicalScene):
    """A role: the controls are a :class:`Policy` of observations, u_t = pi(theta, o(x_t)) + sigma w_t.

    Theta holds the policy's parameters. Every rollout starts at a random state if ``n_start`` is not 0, and J is the
    mean over starts too. One step of ``dt`` is a control step, made of ``substeps`` steps of the integrator. With the
    discount c, the cost of step t counts c^t times and the terminal cost c^horizon times. After :meth:`has_ended` the
    state no longer moves, and :meth:`stage_cost` should be 0 there.

    With ``normalise`` the inputs of the policy are (o - mean) / deviation, measured once, see :func:`observed_moments`.
    """

    n_observations: ClassVar[int]
    n_start: ClassVar[int] = 0
    """Number of standard normal numbers that decide the start of one rollout."""
    moments: ClassVar[tuple[np.ndarray, np.ndarray] | None] = None
    """Mean and deviation of the observations, each ``(n_observations, 1)``, in a program with ``normalise``."""
    program_type: ClassVar[type[Rollout] | None] = PolicyRollout

    noise: str = param("action", "whether noise is on the actions or on theta", choices=("action", "parameter"))
    policy: str = param("linear", "policy, as name or name[parameter=value,...]")
    substeps: int = param(1, "steps of the integrator per control step", positive=True)
    discount: float | None = param(None, "factor on the cost per control step; null: 1", positive=True, high=1.0)
    normalise: int = param(
        0,
        "rollouts under the initial policy whose observations give the mean and deviation that normalise its inputs; 0: none",
        low=0,
    )

    def __post_init__(self) -> None:
        _ = self.plugin  # raises the error of an invalid policy

    @property
    def plugin(self) -> Policy:
        """The policy."""
        return policy_of(self.policy)

    @abstractmethod
    def observation(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the inputs of the policy, ``(n_observations, B)``, each of order 1."""

    def random_start(self, xp: Any, e: Array) -> State:
        """Return the states at t = 0 from standard normal ``e (n_start, B)``; needed only if ``n_start`` is not 0."""
        raise Unsupported(f"scene {self.name} has n_start={self.n_start} and defines no random_start")

    def theta0(self) -> np.ndarray:
        """Return the policy's initial parameters, ``(d,)``."""
        return self.plugin.initial(self.n_observations, self.n_u)

    def cost_weights(self) -> np.ndarray | None:
        """Return the powers of the discount, ``(horizon + 1,)``; None without one."""
        if self.discount is None or self.discount == 1.0:
            return None
        return np.asarray(self.discount ** np.arange(self.horizon + 1.0))

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return the controls of the policy, ``(n_u, B)``."""
        return self.plugin.act(xp, theta, self.normalised(xp, self.observation(xp, q, v)))

    def normalised(self, xp: Any, observation: Array) -> Array:
        """Return the inputs of the policy: the observation, less its mean and over its deviation with ``normalise``."""
        if not self.normalise:
            return observation
        if self.moments is None:
            raise Unsupported("only a program has the moments that normalise observations: use compose and its scene")
        mean, deviation = (xp.asarray(part, dtype=observation.dtype) for part in self.moments)
        return (observation - mean) / deviation

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
        total, by_state = _product(self, theta.shape, states.shape, by_theta)(theta, states, weights)
        return np.asarray(total), np.asarray(by_state)


@remember
def observed_moments(
    scene: PolicyScene, contact: ContactLaw | None, integrator: Integrator | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and deviation of the observations along rollouts, each ``(n_observations, 1)``.

    The ``normalise`` rollouts start at random and follow the initial policy without noise. They are computed in NumPy
    from seed 0, so that all backends, thetas and estimators get the same numbers. States after an end do not count.
    Raises :class:`Unsupported` where NumPy cannot run them.
    """
    plain = dataclasses.replace(scene, normalise=0, noise="action")
    program = PolicyRollout(plain, contact, integrator)
    if program.needs:
        raise Unsupported(
            f"{scene.name}.normalise measures observations along rollouts in NumPy, which lacks {', '.join(sorted(program.needs))}"
        )
    starts = np.random.default_rng(0).standard_normal((scene.n_start, scene.normalise))
    w = np.concatenate([np.zeros((program.n_noise - scene.n_start, scene.normalise)), starts])
    seen = []
    with np.errstate(all="ignore"):
        for state, _ in list(program.steps(LoopOps(), program.theta0[:, None], w))[:-1]:
            ended = plain.has_ended(np, *state)
            observation = plain.observation(np, *state)
            seen.append(observation if ended is None else observation[:, ~ended])
    every = np.concatenate(seen, axis=1)
    if not np.isfinite(every).all():
        raise Unsupported(f"{scene.name}.normalise: rollouts under the initial policy are not finite")
    return every.mean(axis=1, keepdims=True), np.sqrt(every.var(axis=1, keepdims=True) + FLOOR)


def uniform(xp: Any, e: Array) -> Array:
    """Return numbers uniform in (0, 1), ``(n, B)``, from standard normal ``e (2 n, B)``.

    (e1^2 + e2^2) / 2 is exponentially distributed (Box and Muller 1958), so exp of its negative is uniform.
    """
    half = e.shape[0] // 2
    return xp.exp(-0.5 * (e[:half] ** 2 + e[half:] ** 2))


_products: dict[tuple[Any, ...], Callable[..., Any]] = {}
"""Compiled vector-Jacobian products of policies, by scene and the shapes of theta and states."""


def _product(scene: PolicyScene, theta: tuple[int, ...], states: tuple[int, ...], by_theta: bool) -> Callable[..., Any]:
    """Return the compiled product of :meth:`PolicyScene.pullback` for arrays of these shapes."""
    import jax
    import jax.numpy as jnp

    def product(theta: Array, states: Array, weights: Array) -> Any:
        def step(total: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
            x, weight = at

            def controls(theta: Array, x: Array) -> Array:
                return scene.feedback(jnp, theta, x[: scene.n_q], x[scene.n_q :])

            if not by_theta:
                return total, jax.vjp(lambda x: controls(theta, x), x)[1](weight)[0]
            by_parameter, by_state = jax.vjp(controls, theta, x)[1](weight)
            return total + by_parameter, by_state

        # step by step, since the derivatives of all steps by theta would take T times the memory
        steps = (jnp.moveaxis(states, 1, 0), jnp.moveaxis(weights, 1, 0))
        total, by_state = jax.lax.scan(step, jnp.zeros_like(theta), steps)
        return total, jnp.moveaxis(by_state, 0, 1)

    jax.config.update("jax_enable_x64", True)
    key = (scene, *(part.tobytes() for part in scene.moments or ()), theta, states, by_theta)
    if key not in _products:
        _products[key] = jax.jit(product)
    return _products[key]
