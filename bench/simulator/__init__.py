"""A user's cost and gradient as functions of columns: theta of any shape, batches, libraries, counted and timed calls."""

from bench.simulator.clock import Clock, OutOfTime, seconds
from bench.simulator.columns import BATCHES, LIBRARIES, Simulator
from bench.simulator.layout import Layout
from bench.simulator.source import attribute, load

__all__ = ["BATCHES", "LIBRARIES", "Clock", "Layout", "OutOfTime", "Simulator", "attribute", "load", "seconds"]
