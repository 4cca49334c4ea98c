"""Names of the last version that still work for one version, each with a DeprecationWarning that gives the new name."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

NAMES = {
    "GustyScene": "ProcessNoiseScene",
    "HeldScene": "ZeroOrderHoldScene",
    "Judged": "ComparisonRule",
}
"""Public classes: old names and new ones."""
MEMBERS = {
    "leaves_out": "neglected_effects",
    "across_jumps": "unbiased_at_discontinuities",
    "adds_explicit": "includes_explicit_derivative",
    "reports": "diagnostics",
    "explained": "estimate_with_diagnostics",
    "refuses": "unsupported_reason",
    "lacks": "incompatibility",
}
"""Members of plugins: old names and new ones."""
MODULES = {
    "bench.face": "bench.api",
    "bench.simulator": "bench.model.simulator",
    **{
        f"bench.sweep.{name}": f"bench.experiment.{name}"
        for name in ("axes", "cell", "columns", "config", "experiment", "grid", "session", "study")
    },
    **{f"bench.sweep.{name}": f"bench.run.{name}" for name in ("execute", "files", "plan", "references", "store")},
    "bench.sweep": "bench.experiment",
}
"""Modules: old names and new ones."""


def warn(old: str, new: str, level: int = 3) -> None:
    """Warn that a name will go with the next version."""
    warnings.warn(f"{old} is now called {new}; the old name goes with the next version", DeprecationWarning, level)


def lookup(module: str, space: Mapping[str, Any]) -> Callable[[str], Any]:
    """Return a module's ``__getattr__`` that finds the public classes by their old names."""

    def find(name: str) -> Any:
        if name not in NAMES or NAMES[name] not in space:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        warn(f"{module}.{name}", NAMES[name])
        return space[NAMES[name]]

    return find


def rename_members(plugin: type) -> None:
    """Give a plugin class that defines a member under its old name the same member under the new one."""
    for old, new in MEMBERS.items():
        if old in vars(plugin) and new not in vars(plugin) and hasattr(plugin, new):
            warn(f"{plugin.__name__}.{old}", new, 4)
            setattr(plugin, new, vars(plugin)[old])


class _Renamed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports a renamed module under its old name."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for an old name."""
        return importlib.machinery.ModuleSpec(name, self, is_package=True) if name in MODULES else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> None:
        """Let Python make an empty module, which :meth:`exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the module of the new name in the place of the old one."""
        warn(module.__name__, MODULES[module.__name__])
        sys.modules[module.__name__] = importlib.import_module(MODULES[module.__name__])


def install() -> None:
    """Make renamed modules importable under their old names."""
    if not any(isinstance(finder, _Renamed) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Renamed())  # first: the path of the new package would find its modules again
