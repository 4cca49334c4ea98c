"""Compare gradient estimators through physics simulation: bias, variance and cost against a certified gradient.

The Python interface (:func:`run`, :func:`load`, :func:`problem`, :func:`estimate`, :func:`examine`) and the contracts of
plugins.
"""

# ruff: noqa: E402
from bench.interrupts import exit_on_interrupt

exit_on_interrupt()  # before the slow imports

import bench.run  # noqa: F401, before the function of the same name replaces the package here
from bench import deprecated
from bench.api import Estimates, estimate, load, problem, run
from bench.errors import StorageError, UserError
from bench.examine import Report, examine
from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.model import *  # noqa: F403
from bench.model import __all__ as _contracts
from bench.model.simulator.mjcf import Mjcf

__version__ = "0.4.0"
__all__ = [
    *_contracts,
    "Cell",
    "Column",
    "Columns",
    "Estimates",
    "Experiment",
    "ComparisonRule",
    "Mjcf",
    "Report",
    "Session",
    "StorageError",
    "Study",
    "UserError",
    "estimate",
    "examine",
    "load",
    "problem",
    "run",
]

deprecated.install()
__getattr__ = deprecated.lookup(__name__, globals())
