"""Compare gradient estimators through physics simulation: bias, variance and cost against a certified gradient.

- One gradient: :func:`problem` compiles a problem, :func:`estimate` estimates its gradient.
- Experiments: :func:`run` runs one, :func:`load` reads stored rows, :func:`compare` compares two results.
- Your own simulator: :func:`examine` reports whether its gradient is right, :func:`watch` checks it during your loop.
- Plugins: :func:`list` lists them, and :mod:`bench.plugin` has the contracts that their authors import.
"""

import importlib
from typing import TYPE_CHECKING, Any

import bench.compare
import bench.examine
import bench.run
from bench.errors import Unavailable, Unsupported, UserError, needing_sweeps

if TYPE_CHECKING:
    from bench import plugin
    from bench.api import estimate, list_plugins, load, problem, run
    from bench.compare.command import compare
    from bench.examine.examination import examine
    from bench.examine.watch import Watch as watch

    list = list_plugins  # not in __all__: a star import must not replace the built-in type
else:
    del bench, compare, run, examine  # the packages; the functions of these names are imported at their first use

__version__ = "0.5.0"
__all__ = [
    "Unavailable",
    "Unsupported",
    "UserError",
    "compare",
    "estimate",
    "examine",
    "load",
    "plugin",
    "problem",
    "run",
    "watch",
]
_SOURCES = {
    "compare": ("bench.compare.command", "compare"),
    "estimate": ("bench.api", "estimate"),
    "examine": ("bench.examine.examination", "examine"),
    "list": ("bench.api", "list_plugins"),
    "load": ("bench.api", "load"),
    "problem": ("bench.api", "problem"),
    "run": ("bench.api", "run"),
    "watch": ("bench.examine.watch", "Watch"),
}
"""The module and the name of each function that is imported at its first use, so that a command starts quickly."""


def __getattr__(name: str) -> Any:
    if name == "plugin":
        return importlib.import_module("bench.plugin")
    if name not in _SOURCES:
        raise AttributeError(f"module 'bench' has no attribute '{name}'")
    module, function = _SOURCES[name]
    with needing_sweeps(f"bench.{name}"):
        return globals().setdefault(name, getattr(importlib.import_module(module), function))


def __dir__() -> tuple[str, ...]:
    return (*__all__, "__version__", "list")
