"""Compare gradient estimators through physics simulation: bias, variance and cost against a certified gradient.

The Python face (:func:`run`, :func:`load`, :func:`problem`, :func:`estimate`, :func:`examine`) and the contracts that plugin authors import.
"""

# ruff: noqa: E402
from bench.starting import heed_interrupts

heed_interrupts()  # before the imports that take a second

from bench.errors import StorageError, UserError
from bench.examine import Report, examine
from bench.face import Estimates, estimate, load, problem, run
from bench.model import *  # noqa: F403
from bench.model import __all__ as _contracts
from bench.simulator.mjcf import Mjcf
from bench.sweep.cell import Cell
from bench.sweep.columns import Column, Columns, Judged
from bench.sweep.experiment import Experiment
from bench.sweep.session import Session
from bench.sweep.study import Study

__version__ = "0.3.0"
__all__ = [
    *_contracts,
    "Cell",
    "Column",
    "Columns",
    "Estimates",
    "Experiment",
    "Judged",
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
