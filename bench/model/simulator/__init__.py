"""A user's cost and gradient as functions of columns: theta of any shape, batches, libraries, counted and timed calls."""

from bench.model.simulator.clock import Clock, OutOfTime, seconds
from bench.model.simulator.imports import attribute, load
from bench.model.simulator.simulator import BATCHES, LIBRARIES, Simulator
from bench.model.simulator.tree import ParameterTree

__all__ = ["BATCHES", "LIBRARIES", "Clock", "OutOfTime", "ParameterTree", "Simulator", "attribute", "load", "seconds"]
