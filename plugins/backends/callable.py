"""Users' own simulators: costs and gradients from their functions."""

from dataclasses import dataclass

import numpy as np

from bench.model import Backend, CallableProgram, Problem, Program, Unsupported, central_differences, param


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
        return self._costs(theta + self.sigma * w[: self.dim], w[self.dim :])

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        simulator, thetas, noise = self._simulator, theta + self.sigma * w[: self.dim], w[self.dim :]
        if simulator.has_gradient:
            gradients = simulator.gradients(thetas, noise if len(noise) else None)
        else:
            self.usage.rollouts += 2 * self.dim * thetas.shape[1]
            steps = self._step * simulator.layout.scales()
            gradients = central_differences(self._costs, thetas, noise, steps, self.block)
        return np.where(np.isfinite(self._costs(thetas, noise)), gradients, np.nan)

    def _costs(self, thetas: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the costs at thetas ``(d, B)`` with the simulator's own noise ``(n, B)``, which may have no rows."""
        return self._simulator.costs(thetas, noise if len(noise) else None)
