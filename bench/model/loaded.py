"""A user's simulator from the names on a command line."""

from __future__ import annotations

from pathlib import Path

from bench.model.simulator import LIBRARIES, ParameterTree, Simulator, attribute, load
from bench.model.simulator.clock import Clock


def simulator_of(cost: str, theta: str = "theta", grad: str = "", batch: str = "", noise: int = 0) -> Simulator:
    """Return the simulator of ``FILE:NAME`` with a theta and a gradient by their names in the same file."""
    module = load(cost.rpartition(":")[0])
    start = attribute(theta, module)
    gradient = grad if grad in LIBRARIES else attribute(grad, module) if grad else None
    layout = ParameterTree(start() if callable(start) else start)
    return Simulator(attribute(cost), layout, gradient, noise, batch or None, Clock(float("inf")))


def simulator_files(cost: str) -> tuple[Path, ...]:
    """Return the file of ``FILE:NAME``."""
    return (Path(str(load(cost.rpartition(":")[0]).__file__)),)
