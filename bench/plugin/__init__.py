"""The contracts of plugins: everything that authors of scenes, estimators, backends, optimizers and studies import.

:mod:`bench.model` describes the conventions: frozen dataclasses, declared parameters, component-first arrays.
"""

from bench.engines.backend import EngineBackend
from bench.experiment.cell import Cell
from bench.experiment.columns import COMMON, Column, Columns, ComparisonRule
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.experiment.views import Chart, Mark, Style, Table, Views
from bench.model import *  # noqa: F403
from bench.model import __all__ as _contracts

__all__ = [
    *_contracts,
    "COMMON",
    "Cell",
    "Chart",
    "Column",
    "Columns",
    "ComparisonRule",
    "EngineBackend",
    "Experiment",
    "Mark",
    "Session",
    "Study",
    "Style",
    "Table",
    "Views",
]
