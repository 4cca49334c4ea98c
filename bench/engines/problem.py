"""A program whose steps an engine in another Python computes and differentiates."""

from __future__ import annotations

import time

import numpy as np

from bench.engines.process import EngineModel
from bench.model import Program, SteppedProblem


class EngineProblem(SteppedProblem):
    """A program whose engine gets states and controls, and returns states and step Jacobians."""

    def __init__(self, program: Program, model: EngineModel) -> None:
        super().__init__(program)
        self._model = model
        self._first_s: dict[tuple[str, int], float] = {}
        self.engine_s = 0.0
        """Seconds of the engine's own work in all calls, so far."""
        self.pipe_s = 0.0
        """Seconds of all calls so far in which the engine did not work: pipes, copies, and starts of the engine."""
        self.peak_memory_mb = 0.0
        """Largest resident memory of the engine's process, so far."""

    @property
    def settings(self) -> dict[str, str]:
        """The engine's settings that can change its last digits, by name; empty before the first call."""
        return self._model.settings

    def moved(self, first: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Return the engine's states."""
        if self._open_loop:
            return self.call("rollout", first, controls)[0]
        return np.stack([first, *self.call("step", first, controls[0])])

    def step_jacobians(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the engine's step Jacobians; NaN from the first state on that is not finite."""
        shape = (len(controls), states.shape[-1])
        flat = [np.moveaxis(part, 1, 0).reshape(part.shape[1], np.prod(shape)) for part in (states[:-1], controls)]
        a, b = (np.moveaxis(part.reshape(*part.shape[:2], *shape), 2, 0) for part in self.call("jacobians", *flat))
        return a, b

    def call(self, name: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the arrays of the engine's answer to ``step``, ``rollout`` or ``jacobians``."""
        started = time.perf_counter()
        answer, results = self._model.call(name, *arrays)
        seconds, key = answer["seconds"], (name, answer["width"])
        self.pipe_s += time.perf_counter() - started - seconds
        self.engine_s += seconds
        if answer["is_first"]:
            self._first_s[key] = seconds + (self._model.build_s if not self._first_s else 0.0)
            self.compilations.seconds += self._first_s[key]
        self._charge(key, [self._first_s.get(key, 0.0)])
        self.device = self._model.device
        self.peak_memory_mb = max(self.peak_memory_mb, answer["peak_memory_mb"])
        return results
