"""The contracts between the parts: the one file that plugin authors import.

A plugin is a frozen dataclass. Its fields are its parameters, declared with :func:`param` (default, unit,
bounds, meaning); its class variables are facts about it that the conformance kit verifies.

Arrays are component-first and batch-last: generalised positions ``q (n_q, B)``, velocities ``v (n_v, B)``,
controls ``(m, B)``, ``theta (d, B)``, noise ``w (n_w, B)``, costs ``(B,)``. Scenes, contact laws and
integrators are written once, against the array namespace ``ops.xp`` of whichever backend runs them.
A parameter annotated ``float`` may be a traced value, so never branch on it in Python; every other type is static.
"""

from __future__ import annotations

import dataclasses
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np

from bench import blocks
from bench.errors import Unsupported

if TYPE_CHECKING:
    from bench.program import Dynamics, Program

Array = Any
"""An array of the backend in use: NumPy, torch or JAX."""

__all__ = [
    "Array",
    "Backend",
    "Compilations",
    "Contact",
    "ContactLaw",
    "Dynamics",
    "Estimator",
    "ForceLaw",
    "FunctionScene",
    "ImpulseLaw",
    "Integrator",
    "Jacobians",
    "MechanicalScene",
    "Ops",
    "Plugin",
    "Problem",
    "Program",
    "SampleMean",
    "Scene",
    "State",
    "Trajectory",
    "Unsupported",
    "Usage",
    "compilations",
    "param",
]


def __getattr__(name: str) -> Any:
    # Program and Dynamics are part of what a plugin author types against; program.py imports this file.
    if name in ("Program", "Dynamics"):
        import bench.program

        return getattr(bench.program, name)
    raise AttributeError(name)


# --------------------------------------------------------------------------------------------- parameters


def param(
    default: Any,
    doc: str = "",
    unit: str = "",
    *,
    positive: bool = False,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A plugin parameter: its default, meaning and unit, and the values it may take.

    ``positive`` asks for a value above 0; ``low`` and ``high`` are inclusive bounds; ``choices`` the strings allowed.
    """
    return dataclasses.field(
        default=default,
        metadata=dict(doc=doc, unit=unit, positive=positive, low=low, high=high, choices=choices),
    )


@dataclass(frozen=True)
class Plugin:
    """What all plugins share: a name, and parameters as dataclass fields."""

    kind: ClassVar[str] = ""
    """The axis: scenes, contacts, integrators, backends or estimators."""
    name: ClassVar[str] = ""
    """The one name used on the command line, in tables, legends and caches."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Modules that must be installed for the plugin to be available, as ``module`` or ``module=distribution``."""


# ------------------------------------------------------------------------------------------- array operations


class Ops(Protocol):
    """What a backend lends to the model code."""

    @property
    def xp(self) -> Any:
        """Array namespace following the Python array API standard (numpy, torch via array-api-compat, jax.numpy)."""

    def scan(self, step: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """Fold ``carry = step(carry, x)`` over the leading axis of each leaf of the tuple ``xs``; return the last carry."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """``z (n, B)`` with ``residual(z, args) = 0``; column b of the residual depends on column b of z alone.

        Differentiated through the implicit-function theorem. Raises :class:`Unsupported` on backends without it.
        """


# ------------------------------------------------------------------------------------------------------ scenes


class State(NamedTuple):
    """Generalised positions ``q (n_q, B)`` and velocities ``v (n_v, B)``."""

    q: Array
    v: Array


@dataclass(frozen=True)
class Scene(Plugin):
    """A problem: decision variable theta, noise, cost. It models only what its question needs.

    ``J_sigma(theta) = E_w f(theta, w)`` with ``w ~ N(0, I)``; ``sigma`` always multiplies w.
    """

    kind: ClassVar[str] = "scenes"
    leaves_out: ClassVar[str] = ""
    """What the scene does not model, in a few words."""
    continuous: ClassVar[bool] = True
    """Whether the cost is continuous in theta (given a continuous contact law)."""
    noise = "parameter"
    """Noise model: ``parameter`` theta + sigma w, or ``action`` u_t + sigma w_t. Scenes that offer both make it a field."""

    sigma: float = param(0.1, "standard deviation of the Gaussian noise in J", positive=True)

    @abstractmethod
    def theta0(self) -> np.ndarray:
        """The decision variable at which gradients are estimated, ``(d,)``."""

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        """Per coordinate of theta, where the cost jumps or has a kink: panel edges of the quadrature reference."""
        return ()

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Integrator | None) -> np.ndarray | None:
        """Grad J_sigma at :meth:`theta0` of the *program* (this scene under that law and integrator), or None."""
        return None

    def physical_gradient(self) -> np.ndarray | None:
        """Grad f at :meth:`theta0`, without noise, of the *physics* the scene stands for (rigid contact, dt -> 0), or None."""
        return None

    def physical_cost(self) -> float | None:
        """f at :meth:`theta0`, without noise, of the same physics, or None."""
        return None


@dataclass(frozen=True)
class FunctionScene(Scene):
    """A scene that is a plain function of ``x = theta + sigma w``."""

    @abstractmethod
    def cost(self, xp: Any, x: Array) -> Array:
        """f at ``x (d, B)``: ``(B,)``."""


@dataclass(frozen=True)
class MechanicalScene(Scene):
    """A scene with dynamics ``q' = v``, ``v' = acceleration(q, v, u) + contact``, ``horizon`` steps of ``dt``."""

    n_q: ClassVar[int]
    n_v: ClassVar[int | None] = None
    """Length of v where it is not that of q: 0 and 1 make a first-order scene v' = acceleration(v)."""
    n_u: ClassVar[int] = 0
    n_contacts: ClassVar[int] = 0
    open_loop: ClassVar[bool] = False
    """Whether theta is the sequence of controls itself, step by step."""
    contact_values: ClassVar[Mapping[str, Any]] = {}
    """Values this scene gives to the parameters of whatever contact law is used, unless the user sets them."""
    velocity_factor = 1.0
    """Factor on the velocity carried over each step (numerical damping). A field in scenes that have it."""
    restitution = 1.0
    """Normal velocity after an impact over that before, for impulse laws. A field in scenes that have it."""
    needs_physics: ClassVar[bool] = False
    """Whether the scene has no accelerations of its own, only a :meth:`mjcf` twin for backends that provide ``physics``."""
    twin_difference: ClassVar[float] = 1e-9
    """Relative difference that the costs of the twin may have from those of the scene's own program under ``penalty``."""

    horizon: int = param(100, "number of time steps", positive=True)
    dt: float = param(0.01, "length of a time step", "s", positive=True)

    @abstractmethod
    def initial_state(self, xp: Any, theta: Array) -> State:
        """State at t = 0 for ``theta (d, B)``."""

    @abstractmethod
    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Generalised acceleration without contact, ``(n_v, B)``; ``u`` is ``(n_u, B)``."""

    def planned_controls(self, xp: Any, theta: Array) -> Array | None:
        """The part of the control law that looks at no state, ``(horizon, n_u, B)``, or None."""
        return xp.reshape(theta, (self.horizon, self.n_u, theta.shape[1])) if self.open_loop else None

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array | None:
        """The feedback part of the control law, ``(n_u, B)``, added to the planned one, or None."""
        return None

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array | float:
        """Cost of one step, taken at the state before it, ``(B,)``."""
        return 0.0

    @abstractmethod
    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Cost of the state after the last step, ``(B,)``."""

    def gap(self, xp: Any, q: Array) -> Array:
        """Signed distances between bodies, negative in penetration, ``(n_contacts, B)`` [m]."""
        raise NotImplementedError

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        """Time derivative of :meth:`gap`, ``(n_contacts, B)`` [m/s]."""
        raise NotImplementedError

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """M^-1 J^T force for normal forces ``(n_contacts, B)`` [N], linear in them: ``(n_v, B)``."""
        raise NotImplementedError

    def mjcf(self) -> str | None:
        """The scene's twin for physics engines, as the content of an MJCF ``<mujoco>`` element, or None.

        Its joints, slides and hinges, are q in order, its motors take u, and its contact pairs are the contacts. Time
        step, solver and contact springs are the backend's to set; gravity is zero unless an ``<option>`` says otherwise.
        """
        return None

    friction = 0.0
    """Coulomb coefficient of the contacts under a force law. A field in scenes that have friction."""
    slip_speed = 1e-3
    """Slip velocity [m/s] at which regularised friction has grown to tanh(1) of its bound: below it a contact sticks."""

    def slip(self, xp: Any, q: Array, v: Array) -> Array | None:
        """Tangential velocities at the contacts, ``(n_contacts, B)`` [m/s], or None without friction."""
        return None

    def friction_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """M^-1 J_t^T force for tangential forces ``(n_contacts, B)`` [N], linear in them: ``(n_v, B)``."""
        raise NotImplementedError


# ------------------------------------------------------------------------------------------------- contact laws


@dataclass(frozen=True)
class ContactLaw(Plugin):
    """How touching bodies push on each other."""

    kind: ClassVar[str] = "contacts"
    smoothing: ClassVar[str] = ""
    """Name of the parameter that smooths the law, if it has one (``beta``, ``kappa``)."""
    needs_root: ClassVar[bool] = False
    """Whether the law solves an equation each step, so that only backends with ``root`` can run it."""
    continuous = True
    """Whether the state after a step is continuous in the state before it; a property where parameters decide it."""


@dataclass(frozen=True)
class ForceLaw(ContactLaw):
    """A law whose force depends on gap and gap rate, and enters the acceleration."""

    @abstractmethod
    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        """Normal force ``(n_contacts, B)`` [N], positive in repulsion."""


class Contact(NamedTuple):
    """The scene's contact geometry, as an impulse law sees it. Fields are functions; see :class:`MechanicalScene`."""

    gap: Callable[[Array], Array]
    gap_rate: Callable[[Array, Array], Array]
    acceleration: Callable[[Array, Array], Array]
    restitution: Any

    def response(self, xp: Any, q: Array) -> Array:
        """Gap acceleration of each contact per unit of its own force, diag(J M^-1 J^T), ``(n_contacts, B)`` [1/kg]."""
        gap = self.gap(q)
        rows = []
        for i in range(gap.shape[0]):
            unit = xp.stack([0.0 * gap[j] + float(i == j) for j in range(gap.shape[0])])
            rows.append(self.gap_rate(q, self.acceleration(q, unit))[i])
        return xp.stack(rows)


@dataclass(frozen=True)
class ImpulseLaw(ContactLaw):
    """A law that changes velocities (and positions) within a step instead of adding a force."""

    @abstractmethod
    def impulse(self, ops: Ops, contact: Contact, before: State, free: State, dt: Any) -> State:
        """Change of velocity, and of position beyond ``dt`` times the new velocity, over one step.

        ``before`` is the state at the start of the step; ``free`` the one a contact-free step would reach.
        """


# -------------------------------------------------------------------------------------------------- integrators


@dataclass(frozen=True)
class Integrator(Plugin):
    """A time-stepping map."""

    kind: ClassVar[str] = "integrators"
    order: ClassVar[int] = 1
    """Order of the global error in dt on smooth dynamics."""
    takes_impulses: ClassVar[bool] = False
    """Whether a step can take an :class:`ImpulseLaw`."""
    needs_root: ClassVar[bool] = False
    """Whether a step solves an equation, so that only backends with ``root`` can run it."""

    @abstractmethod
    def step(self, dynamics: Dynamics, state: State, u: Array, dt: Any) -> State:
        """The state ``dt`` later under the constant control ``u (n_u, B)``."""

    @abstractmethod
    def amplification(self, z: complex) -> complex:
        """The stability function: the factor of one step on v' = a v (no positions) with z = a dt."""

    @abstractmethod
    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        """The matrix ``(2, 2)`` of one step on q' = v, v' = -stiffness q - damping v with that velocity factor.

        The step is stable while the spectral radius is at most 1.
        """


# ----------------------------------------------------------------------------------------- backends and problems


class Trajectory(NamedTuple):
    """What rollouts pass through, x = (q, v)."""

    states: np.ndarray
    """``(horizon + 1, n, B)``."""
    controls: np.ndarray
    """``(horizon, n_u, B)``."""


class Jacobians(NamedTuple):
    """Derivatives of the step map x_{k+1} = F(x_k, u_k), x = (q, v), along rollouts."""

    states: np.ndarray
    """``(horizon + 1, n, B)``."""
    controls: np.ndarray
    """``(horizon, n_u, B)``."""
    a: np.ndarray
    """dF/dx, ``(horizon, n, n, B)``."""
    b: np.ndarray
    """dF/du, ``(horizon, n, n_u, B)``."""


@dataclass
class Usage:
    """What a stretch of work cost: rollouts, gradients, and seconds of compilation it stood on.

    ``compile_s`` includes ``trace_s``, running the Python code once, and ``lower_s``, turning it into the compiler's input.
    """

    rollouts: int = 0
    gradients: int = 0
    compile_s: float = 0.0
    trace_s: float = 0.0
    lower_s: float = 0.0


@dataclass
class Compilations:
    """What this process has compiled since :meth:`restart`."""

    made: int = 0
    """Compilations, not counting what came from the folder."""
    shapes: set[str] = field(default_factory=set)
    """What programs were asked for: a hash for each program structure, function and shape."""

    @property
    def folder(self) -> str | None:
        """Where compiled programs are kept between runs, as ``BENCH_COMPILE_CACHE`` says; None for nowhere."""
        return os.environ.get("BENCH_COMPILE_CACHE") or None

    def restart(self) -> None:
        """Count from zero."""
        self.made = 0
        self.shapes.clear()


compilations = Compilations()
"""The count of this process, kept by backends that compile."""


class Problem(ABC):
    """A compiled program: costs, gradients and scores of batches of rollouts, in NumPy float64 arrays.

    ``theta`` is ``(d,)`` for one theta shared by all samples or ``(d, B)``; ``w`` is ``(n_w, B)``.
    Larger batches than ``block`` columns are evaluated block by block, so that memory stays flat; blocks are filled up to a
    multiple of ``grain`` columns, so that few shapes occur, and ``threads`` of them run at once.
    """

    block: int = 1 << 16
    grain: int = 1
    threads: int = 1
    device: str = "cpu"
    """What the program runs on."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.usage = Usage()
        self._charged: set[object] = set()
        self._measured = False

    def reset_usage(self) -> None:
        """Count rollouts, gradients and compilations from zero; what is compiled from now on is not taken from a folder."""
        self._measured = True
        self.usage = Usage()
        self._charged.clear()

    def fit_blocks(self, column_bytes: int) -> None:
        """Make blocks of rollouts that keep so many bytes each fit a core's cache, one on every core at once."""
        self.block, self.threads = blocks.fitting(column_bytes, self.grain), blocks.cores()

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise in J."""
        return float(self.program.scene.sigma)

    @property
    def dim(self) -> int:
        """d, the length of theta."""
        return self.program.dim

    @property
    def noise_on_theta(self) -> bool:
        """Whether the noise of J is noise on theta: always, but for action noise under a policy."""
        return self.program.noise_on_theta

    def value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Costs f(theta, w), ``(B,)``."""
        self.usage.rollouts += w.shape[1]
        return self._blocks(self._value, theta, w, ())

    def grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Per-sample gradients df/dtheta, ``(d, B)``."""
        self.usage.gradients += w.shape[1]
        return self._blocks(self._grad, theta, w, (self.dim,))

    def score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Per-sample scores d log p(actions | theta)/dtheta, ``(d, B)``; w / sigma where noise is on theta."""
        if self.noise_on_theta:
            return w / self.sigma
        return self._blocks(self._score, theta, w, (self.dim,))

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        """States and controls along each rollout; raises :class:`Unsupported` where there are none."""
        raise Unsupported("this backend shows no states")

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """States, controls and step Jacobians along each rollout; raises :class:`Unsupported` where there are none."""
        raise Unsupported("this backend gives no step Jacobians")

    def directions(self, w: np.ndarray) -> np.ndarray:
        """Standard normal directions in theta space made from ``w``, ``(d, B)``.

        Raises :class:`Unsupported` when a sample carries fewer than d normal numbers.
        """
        if w.shape[0] < self.dim:
            raise Unsupported(f"needs {self.dim} normal numbers a sample, this noise model has {w.shape[0]}")
        return w[: self.dim]

    def displaced(self, shift: np.ndarray, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Costs at ``theta + shift`` with ``shift (d, B)`` and the noise ``w`` of the cost, ``(B,)``."""
        return self.value(np.asarray(theta).reshape(self.dim, -1) + shift, w)

    def _blocks(
        self, function: Callable[..., np.ndarray], theta: np.ndarray, w: np.ndarray, lead: tuple[int, ...]
    ) -> np.ndarray:
        theta = np.asarray(theta, dtype=np.float64).reshape(self.dim, -1)
        w = np.asarray(w, dtype=np.float64)
        columns = blocks.size(w.shape[1], self.block, self.grain, self.threads)
        return blocks.evaluate(function, theta, w, columns, self.threads, lead)

    @abstractmethod
    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Backend(Plugin):
    """What executes a program and how it differentiates it."""

    kind: ClassVar[str] = "backends"
    provides: ClassVar[frozenset[str]] = frozenset({"value", "grad", "score"})
    """Capabilities, out of ``value``, ``grad``, ``score``, ``root`` and ``physics``.

    With ``physics`` the backend steps a scene's :meth:`~MechanicalScene.mjcf` twin by an integrator and a contact solver of
    its own: its programs are not those of other backends, and have reference gradients of their own.
    """
    compiles: ClassVar[bool] = False
    """Whether each new batch shape costs a compilation, so that estimates are best made one by one."""
    reference_rank: ClassVar[int | None] = None
    """Order in which backends are asked to compute reference gradients, smallest first; None: never."""

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64", "float32"))

    @abstractmethod
    def compile(self, program: Program) -> Problem:
        """The program made ready to run."""

    def refuses(self, program: Program) -> str | None:
        """Why this backend cannot run the program, or None."""
        return None


# --------------------------------------------------------------------------------------------------- estimators


@dataclass(frozen=True)
class Estimator(Plugin):
    """Turns sampled costs and gradients into independent estimates of grad J."""

    kind: ClassVar[str] = "estimators"
    needs: ClassVar[frozenset[str]] = frozenset({"value"})
    """Backend capabilities used, out of ``value``, ``grad`` and ``score``."""
    target: ClassVar[str] = "smoothed"
    """What is estimated: ``smoothed`` grad J_sigma, or the ``plain`` grad f."""
    unbiased: ClassVar[bool] = True
    """Whether the expectation is the target for continuous costs."""
    across_jumps: ClassVar[bool] = False
    """Whether that stays so when the cost jumps in theta."""

    @abstractmethod
    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """R independent estimates ``(R, d)`` at ``theta (d,)`` from standard normal ``noise (R, N, n_w)``.

        Randomness comes from ``noise`` alone: estimate r depends on ``noise[r]`` and on nothing else random.
        """

    def refuses(self, program: Program) -> str | None:
        """Why this estimator cannot be used on the program, or None."""
        return None


@dataclass(frozen=True)
class SampleMean(Estimator):
    """An estimator that is the mean of one term per sample."""

    @abstractmethod
    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Per-sample terms ``(d, B)`` for noise ``w (n_w, B)``."""

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """The mean of the terms over the samples of each repeat."""
        return per_repeat(self.terms(problem, theta, columns(noise)), noise).mean(axis=1)


def columns(noise: np.ndarray) -> np.ndarray:
    """Noise ``(R, N, n_w)`` as the batch ``(n_w, R * N)`` that problems take."""
    return np.moveaxis(noise, -1, 0).reshape(noise.shape[-1], -1)


def per_repeat(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Batch results ``(d, R * N)`` as ``(R, N, d)``, or ``(R * N,)`` as ``(R, N)``."""
    repeats, samples = noise.shape[:2]
    if values.ndim == 1:
        return values.reshape(repeats, samples)
    return np.moveaxis(values.reshape(-1, repeats, samples), 0, -1)
