"""Users' own simulators: costs and gradients from their functions."""

from dataclasses import dataclass

import numpy as np

from bench.model import Backend, CallableProgram, Problem, Program, Unsupported, param


@dataclass(frozen=True)
class CallableBackend(Backend):
    """Gradients: the user's own function or library, or central differences of the cost if there is none."""

    name = "callable"
    provides = Backend.provides | {"simulator"}
    reference_rank = 9

    step: float = param(1e-5, "step of the central differences, in units of each input's scale", positive=True)

    def compile(self, program: Program) -> Problem:
        """Return the simulator as a problem; raises :class:`Unsupported` for any other program."""
        if reason := self.own_refusal(program):
            raise Unsupported(reason)
        assert isinstance(program, CallableProgram)
        return CallableProblem(program, self.step)

    def own_refusal(self, program: Program) -> str | None:
        """Return why the program cannot run: it is not a user's own simulator, or single precision is set; or None."""
        if not isinstance(program, CallableProgram):
            return f"scene {program.scene.name} is not a user's own simulator"
        return None if self.dtype == "float64" else "the simulator chooses its own precision: omit dtype"


class CallableProblem(Problem):
    """A user's simulator as a problem."""

    def __init__(self, program: CallableProgram, step: float) -> None:
        super().__init__(program)
        self._simulator, self._step = program.scene.simulator(), step

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._simulator.costs(*self._split(theta, w))

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        thetas, noise = self._split(theta, w)
        gradients = (
            self._simulator.gradients(thetas, noise)
            if self._simulator.has_gradient
            else self._differences(thetas, noise)
        )
        return np.where(np.isfinite(self._simulator.costs(thetas, noise)), gradients, np.nan)

    def _differences(self, thetas: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        self.usage.rollouts += 2 * self.dim * thetas.shape[1]
        rows = []
        for i, scale in enumerate(self._simulator.layout.scales()):
            step = np.zeros((self.dim, 1))
            step[i] = self._step * scale
            up, down = self._simulator.costs(thetas + step, noise), self._simulator.costs(thetas - step, noise)
            rows.append((up - down) / (2 * step[i]))
        return np.stack(rows)

    def _split(self, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return theta plus its noise, ``(d, B)``, and the simulator's own noise ``(n, B)`` or None."""
        return theta + self.sigma * w[: self.dim], w[self.dim :] if w.shape[0] > self.dim else None
