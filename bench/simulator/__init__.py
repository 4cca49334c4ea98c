"""A user's cost and gradient as batched functions, for theta of any structure and any array library."""

from bench.simulator.clock import Clock, OutOfTime, parse_duration
from bench.simulator.imports import load_attribute, load_module, load_simulator, simulator_files
from bench.simulator.simulator import BATCHES, LIBRARIES, Simulator
from bench.simulator.tree import ParameterTree

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
