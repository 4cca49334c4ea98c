"""A user's cost and gradient as batched functions, for theta of any structure and any array library."""

from bench.model.simulator.clock import Clock, OutOfTime, parse_duration
from bench.model.simulator.imports import load_attribute, load_module, load_simulator, simulator_files
from bench.model.simulator.simulator import BATCHES, LIBRARIES, Simulator
from bench.model.simulator.tree import ParameterTree

__all__ = [
    "BATCHES",
    "LIBRARIES",
    "Clock",
    "OutOfTime",
    "ParameterTree",
    "Simulator",
    "load_attribute",
    "load_module",
    "load_simulator",
    "parse_duration",
    "simulator_files",
]
