"""Loads functions from a user's file, given as on the command line: ``mysim.py:cost`` or ``package.module:cost``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import UserError, failure, unknown
from bench.simulator.clock import Clock
from bench.simulator.simulator import LIBRARIES, Simulator
from bench.simulator.tree import ParameterTree


def load_attribute(text: str, module: ModuleType | None = None, what: str = "name", more: Iterable[str] = ()) -> Any:
    """Return the object ``FILE:NAME`` or ``MODULE:NAME``; a name without a file is looked up in ``module``.

    Raises :class:`UserError` if the file or name does not exist, or if the file cannot be imported. The error calls the name
    ``what``, and lists the names that the module defines, and ``more`` that the caller allows.
    """
    place, _, name = text.rpartition(":")
    if place:
        module = load_module(place)
    elif module is None:
        raise UserError(f"'{text}' does not name a function: give FILE:NAME, for example mysim.py:cost")
    value: Any = module
    for part in name.split("."):
        if not hasattr(value, part):
            names = [key for key, own in vars(module).items() if not key.startswith("_") and _is_of(module, own)]
            raise unknown(f"{what} in {place}:" if place else what, name, {*more, *names})
        value = getattr(value, part)
    return value


def _is_of(module: ModuleType, value: Any) -> bool:
    """Return whether a module defines a value, as opposed to a function or a module that it imports."""
    return (
        getattr(value, "__module__", None) == module.__name__ if callable(value) else not isinstance(value, ModuleType)
    )


def load_module(place: str) -> ModuleType:
    """Import a file or module once and return it. A file can import from its own folder, as when Python runs it."""
    if not place.endswith(".py"):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError as error:
            raise UserError(
                f"there is no module '{place}': give a file, mysim.py:cost, or a module ({error})"
            ) from None
        except BaseException as error:
            raise _unusable(place, error) from None
    path = Path(place).expanduser().resolve()
    if not path.is_file():
        raise UserError(f"there is no file '{place}'")
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
    name = _module_name(path)
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        raise _unusable(place, error) from None
    return module


def _unusable(place: str, error: BaseException) -> BaseException:
    """Return the error for a file whose import raised one; an interrupt of the command is returned as it is."""
    if isinstance(error, KeyboardInterrupt):
        return error
    if isinstance(error, SystemExit):
        return UserError(f"'{place}' ends the process when it is imported: put that under if __name__ == \"__main__\"")
    return UserError(f"'{place}' cannot be imported: {failure(error)['reason']}")


def _module_name(path: Path) -> str:
    """Return the file's own name, by which processes that it starts can import it, or another if another module has that."""
    invented = f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if invented in sys.modules or not path.stem.isidentifier():
        return invented
    try:
        found = importlib.util.find_spec(path.stem)
    except ValueError:  # a module without a file, such as __main__
        return invented
    return path.stem if found is not None and found.origin == str(path) else invented


@cache
def load_simulator(cost: str, theta: str, grad: str, batch: str, noise: int) -> Simulator:
    """Return the simulator of the cost ``FILE:NAME``. ``theta`` and ``grad`` are names in the same file.

    ``grad`` may also be ``jax`` or ``torch``, or empty for a simulator without a gradient.
    """
    module = load_module(cost.rpartition(":")[0])
    start = load_attribute(theta, module)
    gradient = grad if grad in LIBRARIES else load_attribute(grad, module) if grad else None
    layout = ParameterTree(start() if callable(start) else start)
    return Simulator(load_attribute(cost), layout, gradient, noise, batch or None, Clock(float("inf")))


def simulator_files(cost: str) -> tuple[Path, ...]:
    """Return the file that defines the cost ``FILE:NAME``."""
    return (Path(str(load_module(cost.rpartition(":")[0]).__file__)),)
