"""A user's cost and gradient as batched functions, for theta of any structure and any array library."""

from bench.simulator.imports import load_module, load_simulator, simulator_files
from bench.simulator.simulator import Simulator

__all__ = ["Simulator", "load_module", "load_simulator", "simulator_files"]
