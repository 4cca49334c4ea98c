"""A compiled program: costs, gradients and scores of batches of rollouts, and their computational cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.errors import Unsupported, UserError, printable
from bench.host.identity import label
from bench.host.parameters import parameters
from bench.model import blocks
from bench.model.program import Program

if TYPE_CHECKING:
    import pandas as pd

NOT_DEFINED = "{0} computes no {1}: define {0}._{2}, or leave '{2}' out of the backend's `provides`"


class Trajectory(NamedTuple):
    """The states x = (q, v) and the controls of rollouts."""

    states: np.ndarray
    """``(horizon + 1, n, B)``."""
    controls: np.ndarray
    """``(horizon, n_u, B)``."""


class Jacobians(NamedTuple):
    """Derivatives of the step map x_{t+1} = F(x_t, u_t), x = (q, v), along rollouts.

    They are derivatives by changes of the state, of length k: n, or less if q is on a manifold, as in a
    :class:`~bench.model.manifold.JointScene`.
    """

    states: np.ndarray
    """``(horizon + 1, n, B)``."""
    controls: np.ndarray
    """``(horizon, n_u, B)``."""
    a: np.ndarray
    """dF/dx, ``(horizon, k, k, B)``."""
    b: np.ndarray
    """dF/du, ``(horizon, k, n_u, B)``."""


@dataclass
class Usage:
    """Computational cost: numbers of rollouts and gradients, and compile times in seconds.

    ``compile_s`` includes ``trace_s``, which runs the Python code once, and ``lower_s``, which converts it to the
    compiler's input.
    """

    rollouts: int = 0
    gradients: int = 0
    compile_s: float = 0.0
    trace_s: float = 0.0
    lower_s: float = 0.0


@dataclass(frozen=True)
class Executable:
    """A compiled function, the seconds of each part of its compilation, and whether it was loaded from a folder."""

    name: str
    call: Callable[..., Any]
    seconds: tuple[float, ...]
    loaded: bool


@dataclass
class Compilations:
    """Compilation counts of one session, and the folder in which compiled programs are stored.

    Compiling backends update the counts. Code that builds several problems passes the same object to all of them.
    """

    folder: Path | None = None
    """Folder in which compiled programs are stored between runs; None to store none."""
    made: int = 0
    """Number of compilations, excluding programs loaded from the folder."""
    seconds: float = 0.0
    """Time of these compilations [s]."""
    shapes: set[str] = field(default_factory=set)
    """Hashes of the requested programs, one per program structure, function and shape."""

    def obtain(
        self, known: dict[Any, Executable], key: Any, fresh: bool, make: Callable[[Path | None], Executable]
    ) -> Executable:
        """Return the executable of ``key`` from ``known``, of which it becomes the last; made if it is missing.

        ``make`` gets the folder. With ``fresh`` it gets none, and an executable loaded from the folder is made again, so
        that the seconds are a true compile time.
        """
        executable = known.pop(key, None)
        if executable is None or (fresh and executable.loaded):
            executable = make(None if fresh else self.folder)
            if not executable.loaded:
                self.made += 1
                self.seconds += sum(executable.seconds)
        known[key] = executable
        self.shapes.add(executable.name)
        return executable

    def restart(self) -> None:
        """Reset the counts to zero."""
        self.made, self.seconds = 0, 0.0
        self.shapes.clear()


class Problem(ABC):
    """A compiled program: costs, gradients and scores of batches of rollouts, in NumPy float64 arrays.

    ``theta`` is ``(d,)``, shared by all samples, or ``(d, B)``; ``w`` is ``(n_w, B)``. To limit memory, batches larger
    than ``block`` columns are split into blocks. Blocks are padded to a multiple of ``grain`` columns. Up to ``threads`` blocks run
    in parallel, each with about ``least`` columns or more.
    """

    block: int = 1 << 16
    grain: int = 1
    threads: int = 1
    least: int = blocks.MIN_COLUMNS
    device: str = "cpu"
    """The device that the program runs on."""
    provides: frozenset[str] = frozenset({"value", "grad", "score"})
    """Capabilities of the backend that compiled the program."""
    backend: str = ""
    """Identity string of that backend, where it was given as one."""
    step = 0.0
    """Step of the differences of the cost that are the gradient, in units of theta; 0 for another gradient."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.usage = Usage()
        self.compilations = Compilations()
        self._charged: set[object] = set()
        self._measured = False

    def reset_usage(self) -> None:
        """Reset usage to zero. From then on, programs are compiled instead of loaded from the folder."""
        self._measured = True
        self.usage = Usage()
        self._charged.clear()

    def _charge(self, key: object, seconds: Sequence[float]) -> None:
        """Add the compile time of an executable, once in each measurement: of tracing, lowering and the rest, or in all."""
        if key not in self._charged:
            self._charged.add(key)
            self.usage.compile_s += sum(seconds)
            if len(seconds) > 1:
                self.usage.trace_s += seconds[0]
                self.usage.lower_s += seconds[1]

    def fit_blocks(self, column_bytes: int) -> None:
        """Set the block size so that a block fills at most half of a core's cache, at ``column_bytes`` per rollout."""
        self.block, self.threads = blocks.columns_in_cache(column_bytes), blocks.cores()

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
        """Whether the noise in J acts on theta: true except for action noise under a feedback policy."""
        return self.program.noise_on_theta

    def value(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the costs f(theta, w), ``(B,)``, or ``()`` for one sample ``w (n_w,)``; see :meth:`grad`."""
        theta, w, is_single = self._arguments(theta, w)
        self.usage.rollouts += w.shape[1]
        costs = self._blocks(self._value, theta, w, ())
        return costs[0] if is_single else costs

    def grad(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the gradient df/dtheta of each sample, ``(d, B)``, or ``(d,)`` for one sample ``w (n_w,)``.

        ``theta`` is ``(d,)`` or ``(d, B)``, by default ``theta0``. ``w`` is ``(n_w,)`` or ``(n_w, B)``, by default 0,
        without noise. Both may be lists. Raises :class:`bench.UserError` for other shapes.
        """
        theta, w, is_single = self._arguments(theta, w)
        self.usage.gradients += w.shape[1]
        gradients = self._blocks(self._grad, theta, w, (self.dim,))
        return gradients[:, 0] if is_single else gradients

    def second_gradient(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the gradient of each sample by a second method of differentiation, ``(d, B)``.

        Raises :class:`Unsupported` where the backend has only one.
        """
        raise Unsupported(f"{type(self).__name__} has one method of differentiation")

    def score(self, theta: ArrayLike | None = None, w: ArrayLike | None = None) -> np.ndarray:
        """Return the score d log p(actions | theta)/dtheta of each sample, ``(d, B)``: w / sigma for noise on theta.

        ``(d,)`` for one sample, see :meth:`grad`. Raises :class:`Unsupported` if cost times score is not the gradient, see
        :attr:`Program.score_refusal`.
        """
        theta, w, is_single = self._arguments(theta, w)
        is_known = self.noise_on_theta
        if not is_known and self.program.score_refusal:
            raise Unsupported(self.program.score_refusal)
        scores = w[: self.dim] / self.sigma if is_known else self._blocks(self._score, theta, w, (self.dim,))
        return scores[:, 0] if is_single else scores

    def _arguments(self, theta: ArrayLike | None, w: ArrayLike | None) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return theta, noise ``(n_w, B)``, and whether one sample was given as a vector."""
        n_noise = self.program.n_noise
        at = np.asarray(self.program.theta0 if theta is None else theta, dtype=np.float64)
        if at.ndim not in (1, 2) or len(at) != self.dim:
            raise UserError(f"theta has the shape {at.shape}: give ({self.dim},) or ({self.dim}, B)")
        noise = np.zeros(n_noise) if w is None else np.asarray(w, dtype=np.float64)
        if noise.ndim not in (1, 2) or len(noise) != n_noise:
            raise UserError(f"noise w has the shape {noise.shape}: give ({n_noise},) or ({n_noise}, B)")
        if noise.ndim == 2:
            return at, noise, False
        columns = 1 if at.ndim == 1 else at.shape[1]
        return at, np.broadcast_to(noise[:, None], (n_noise, columns)), at.ndim == 1

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        """Return states and controls along each rollout; raises :class:`Unsupported` if the backend has none."""
        raise Unsupported(
            f"{type(self).__name__} does not expose the states of a rollout: use a backend with trajectory()"
        )

    @property
    def gives_jacobians(self) -> bool:
        """Whether :meth:`jacobians` is defined."""
        return type(self).jacobians is not Problem.jacobians

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Jacobians:
        """Return states, controls and step Jacobians; raises :class:`Unsupported` if the backend has none."""
        raise Unsupported(f"{type(self).__name__} gives no step Jacobians: use a backend with jacobians()")

    def centred(self, w: np.ndarray) -> np.ndarray:
        """Return noise ``(n_w, B)`` with the noise on theta or actions set to 0, and the scene's own noise unchanged."""
        centred = np.zeros_like(w)
        if count := self.program.exogenous:
            centred[-count:] = w[-count:]
        return centred

    def directions(self, w: np.ndarray) -> np.ndarray:
        """Return standard normal directions in theta space, ``(d, B)``: the first d rows of ``w``.

        Raises :class:`Unsupported` if a sample has fewer than d normal numbers.
        """
        own = w.shape[0] - self.program.exogenous
        if own < self.dim:
            raise Unsupported(f"needs {self.dim} normal numbers per sample, and this noise model has {own}")
        return w[: self.dim]

    def displaced(self, shift: np.ndarray, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the costs at ``theta + shift`` for ``shift (d, B)`` and noise ``w (n_w, B)``: ``(B,)``."""
        return self.value(np.asarray(theta).reshape(self.dim, -1) + shift, w)

    def _blocks(
        self, function: Callable[..., np.ndarray], theta: np.ndarray, w: np.ndarray, lead: tuple[int, ...]
    ) -> np.ndarray:
        theta = theta.reshape(self.dim, -1)
        threads = blocks.n_threads(w.shape[1], self.threads, self.least)
        columns = blocks.block_size(w.shape[1], self.block, self.grain, threads)

        def real(theta: np.ndarray, w: np.ndarray) -> np.ndarray:
            values = function(theta, w)
            if np.iscomplexobj(values):
                raise TypeError(f"{type(self).__name__}{function.__name__} returns complex numbers: costs must be real")
            return values

        return blocks.evaluate(real, theta, w, columns, threads, lead)

    @property
    def title(self) -> str:
        """Identity strings of scene, contact law, integrator and backend."""
        return printable(", ".join([*map(label, self.program.parts.values()), self.backend]))

    def __repr__(self) -> str:
        texts = [f"{value:.4g}" for value in self.program.theta0]
        theta = ", ".join(texts if len(texts) <= 6 else [*texts[:3], "...", *texts[-2:]])
        on = "theta" if self.program.noise == "parameter" else "the actions"
        noise = f"sigma = {self.sigma:g} on {on}, n_w = {self.program.n_noise}"
        return f"Problem: {self.title}; theta = [{theta}], d = {self.dim}; noise: {noise}"

    def to_frame(self) -> pd.DataFrame:
        """Return all parameters of scene, contact law and integrator: part, plugin, name, value, unit and meaning."""
        import pandas as pd

        rows = [
            {"part": axis, "plugin": part.name, "parameter": name, "value": getattr(part, name)}
            | {"unit": parameter.unit, "meaning": parameter.doc}
            for axis, part in self.program.parts.items()
            for name, parameter in parameters(type(part)).items()
        ]
        return pd.DataFrame(rows, columns=["part", "plugin", "parameter", "value", "unit", "meaning"])

    @abstractmethod
    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray: ...

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        raise Unsupported(NOT_DEFINED.format(type(self).__name__, "gradients", "grad"))

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        raise Unsupported(NOT_DEFINED.format(type(self).__name__, "scores", "score"))
