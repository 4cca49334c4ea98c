"""Compare gradient estimators through physics simulation: bias, variance and cost against a certified gradient.

- One gradient: :func:`problem` compiles a problem, :func:`estimate` estimates its gradient.
- Experiments: :func:`run` runs one, :func:`load` reads stored rows, :func:`compare` compares two results.
- Your own simulator: :func:`examine` reports whether its gradient is right.
- Plugins: :func:`list` lists them, and :mod:`bench.plugin` has the contracts that their authors import.
"""

import bench.run  # noqa: F401, before the function of the same name replaces the package here
from bench import plugin
from bench.api import estimate, list_plugins, load, problem, run
from bench.compare import compare
from bench.errors import Unsupported, UserError
from bench.examine import examine

list = list_plugins  # not in __all__: a star import must not replace the built-in type

__version__ = "0.5.0"
__all__ = [
    "Unsupported",
    "UserError",
    "compare",
    "estimate",
    "examine",
    "load",
    "plugin",
    "problem",
    "run",
]


def __dir__() -> tuple[str, ...]:
    return (*__all__, "__version__", "list")
