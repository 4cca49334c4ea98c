"""Old names that remain valid for one version. Each use issues a DeprecationWarning that states the new name."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

NAMES = {
    "GustyScene": "ProcessNoiseScene",
    "HeldScene": "ZeroOrderHoldScene",
    "Judged": "ComparisonRule",
    "simulator_of": "load_simulator",
}
"""New names of public classes and functions, by old name."""
HOMES = {"Estimates": "bench.notebook", "Report": "bench.examine", "StorageError": "bench.errors"}
"""Modules of the names that ``bench`` no longer has, besides the contracts of plugins."""
MEMBERS = {
    "leaves_out": "neglected_effects",
    "across_jumps": "unbiased_at_discontinuities",
    "adds_explicit": "includes_explicit_derivative",
    "reports": "diagnostics",
    "explained": "estimate_with_diagnostics",
    "refuses": "unsupported_reason",
    "lacks": "incompatibility",
    "wants": "required_fields",
}
"""New names of plugin members, by old name."""
EXPERIMENTS = {"quick_optimise": "optimise/small"}
"""New names of experiments, by old name."""
MODULES = {
    "bench.face": ("bench.api",),
    "bench.model.known": ("bench.model.known_solutions",),
    "bench.model.loaded": ("bench.model.simulator.imports",),
    "bench.simulator.columns": ("bench.model.simulator.simulator",),
    "bench.simulator.layout": ("bench.model.simulator.tree",),
    "bench.simulator.source": ("bench.model.simulator.imports",),
    "bench.claims.pieces": ("bench.claims.toolkit",),
    "bench.simulator": ("bench.model.simulator",),
    "bench.sweep.guardian": ("bench.run.reaper",),
    "bench.sweep.workers": ("bench.run.pool",),
    "bench.sweep": ("bench.experiment", "bench.run"),
}
"""New names of modules and packages, by old name. Several new names are tried in order."""


def warn(old: str, new: str, level: int = 3) -> None:
    """Issue a DeprecationWarning that an old name will be removed in the next version."""
    warnings.warn(sentence(old, new), DeprecationWarning, level)


def sentence(old: str, new: str) -> str:
    """Return the sentence that an old name will be removed in the next version."""
    return f"{old} is now called {new}; the old name will be removed in the next version"


def lookup(module: str, namespace: Mapping[str, Any], homes: Mapping[str, str] | None = None) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a module that resolves the old names of public classes and functions.

    ``homes`` are the modules of names that have moved, by present name.
    """

    def resolve(name: str) -> Any:
        new = NAMES.get(name, name)
        home = (homes or {}).get(new, "")
        if not home and (new == name or new not in namespace):
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        warn(f"{module}.{name}", f"{home}.{new}" if home else new)
        return getattr(importlib.import_module(home), new) if home else namespace[new]

    return resolve


class Alias:
    """A class member's old name, as a descriptor. ``super().old`` in a subclass resolves to the member of this class."""

    def __init__(self, old: str, new: str, member: Any) -> None:
        self.old, self.new, self.member = old, new, member

    def __get__(self, instance: Any, owner: type) -> Any:
        warn(f"{owner.__name__}.{self.old}", self.new)
        bind = getattr(type(self.member), "__get__", None)
        return self.member if bind is None else bind(self.member, instance, owner)


def rename_members(plugin: type) -> None:
    """Make a plugin class's renamed members available under both their old and new names.

    A member that the class or one of its mixins defines under the old name is also defined under the new name. A member
    that the class defines under the new name remains available under the old name.
    """
    for old, new in MEMBERS.items():
        if not hasattr(plugin, new):
            continue
        for base in plugin.__mro__:
            if new in vars(base):
                break
            if old in vars(base) and not isinstance(vars(base)[old], Alias):
                _warn_at(plugin, old, new)
                setattr(plugin, new, vars(base)[old])
                break
        if new in vars(plugin):
            setattr(plugin, old, Alias(old, new, vars(plugin)[new]))


def _warn_at(plugin: type, old: str, new: str) -> None:
    """Issue the warning at the class definition, the first caller outside the ``__init_subclass__`` chain."""
    frame, level = sys._getframe(2), 4
    while frame.f_back is not None and frame.f_code.co_name in ("__init_subclass__", "__new__"):
        frame, level = frame.f_back, level + 1
    warn(f"{plugin.__name__}.{old}", new, level)


class _OldModules(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports renamed modules under their old names."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for an old name, with the file of the new module; None for any other name."""
        new = _new_module(name)
        if new is None:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=new.origin, loader_state=new.name, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> None:
        """Let Python create an empty module, which :meth:`exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        """Replace the empty module by the module of the new name."""
        assert module.__spec__ is not None
        new = module.__spec__.loader_state
        warn(module.__name__, new)
        sys.modules[module.__name__] = importlib.import_module(new)


def _new_module(name: str) -> importlib.machinery.ModuleSpec | None:
    """Return the spec of the module that replaces an old module name, or None if the name is not an old one."""
    old = name
    while old and old not in MODULES:
        old = old.rpartition(".")[0]
    for package in MODULES.get(old, ()):
        spec = importlib.util.find_spec(package + name.removeprefix(old))
        if spec is not None:
            return spec
    return None


def install() -> None:
    """Make renamed modules importable under their old names."""
    if not any(isinstance(finder, _OldModules) for finder in sys.meta_path):
        # before the standard finders, which would load the modules of the new package a second time
        sys.meta_path.insert(0, _OldModules())
