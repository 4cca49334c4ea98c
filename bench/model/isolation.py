"""Detects and undoes changes of process state that would change the numbers of later cells.

A plugin may change a library's configuration, a default type, an environment variable, or a function of NumPy, SciPy,
JAX, torch or this package. :class:`State` records all of that, names what has changed since, and restores it. Imports of
installed libraries are not changes: libraries set their own configuration when they are imported.
"""

from __future__ import annotations

import builtins
import ctypes
import decimal
import gc
import importlib.abc
import importlib.machinery
import locale
import os
import random
import sys
import sysconfig
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from bench.errors import printable

MODULES = (
    "builtins", "json", "math", "random", "time",
    "numpy", "numpy.fft", "numpy.linalg", "numpy.random",
    "scipy.fft", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.sparse",
    "scipy.sparse.linalg", "scipy.special", "scipy.stats",
    "jax", "jax.lax", "jax.nn", "jax.numpy", "jax.numpy.linalg", "jax.random", "jax.scipy.linalg", "jax.scipy.special",
    "jax.tree", "jax.tree_util",
    "torch", "torch.autograd", "torch.func", "torch.linalg", "torch.nn.functional", "torch.special",
)  # fmt: skip
"""Libraries' modules whose functions are checked, where they are imported."""
CLASSES = {"torch": ("Tensor",)}
"""Libraries' classes whose methods are checked, by module."""
OWN = ("bench.experiment", "bench.measure", "bench.model", "bench.plugins", "bench.run", "bench.studies")
"""Packages whose modules and classes are checked."""
HARMLESS_JAX = ("cache", "log", "dump", "traceback", "compilation")
"""Parts of the names of JAX settings that decide no number."""
HARMLESS_VARIABLES = (b"EQX_ON_ERROR", b"PYTEST_CURRENT_TEST")
"""Environment variables that decide no number: equinox reads its own when it is imported, right after a backend sets it."""
MAX_NAMES = 4
"""Number of changed names that a sentence lists."""
ONE, SMALLEST = 1.0, 5e-324
"""1 and the smallest denormal float64."""
MISSING: Any = object()
STANDARD_LIBRARY = sysconfig.get_path("stdlib")
"""The folder of the standard library."""


@dataclass(frozen=True)
class Setting:
    """A part of the process state: how to read it and how to restore it."""

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], Any] | None = None
    """None if it cannot be restored."""
    library: str = ""
    """The library that must be imported; empty for none."""
    names_parts: bool = False
    """Whether the value is a mapping whose changed keys are listed."""
    is_scoped: bool = False
    """Whether a ``with`` block of the library sets it, so that it may differ while another library is imported in one."""


def _torch() -> Any:
    return sys.modules["torch"]


def _jax() -> Any:
    return sys.modules["jax"]


def _working_folder() -> str:
    """Return the working folder, or an empty string if it has been removed."""
    try:
        return os.getcwd()
    except FileNotFoundError:
        return ""


def _environment() -> dict[bytes, bytes]:
    # os.environ decodes every value, which is slow
    values: dict[bytes, bytes] = os.environ._data.copy()  # type: ignore[attr-defined]
    for name in HARMLESS_VARIABLES:
        values.pop(name, None)
    return values


def _write_environment(values: Mapping[bytes, bytes]) -> None:
    for name in os.environb.keys() - values.keys() - set(HARMLESS_VARIABLES):
        del os.environb[name]
    os.environb.update(values)


def _jax_settings() -> dict[str, Any]:
    values: Mapping[str, Any] = _jax().config.values
    return {name: values[name] for name in _jax_names(len(values))}


@cache
def _jax_names(n_settings: int) -> list[str]:
    """Return the names of the JAX settings that decide numbers; cached by the number of settings."""
    return [name for name in _jax().config.values if not any(part in name for part in HARMLESS_JAX)]


def _write_jax(values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if _jax().config.values[name] != value:
            _jax().config.update(name, value)


def _error_filters() -> list[Any]:
    return [entry for entry in warnings.filters if entry[0] == "error"]


def _write_error_filters(entries: Sequence[Any]) -> None:
    warnings.filters[:] = [*entries, *(entry for entry in warnings.filters if entry[0] != "error")]  # type: ignore[index]
    warnings._filters_mutated()  # type: ignore[attr-defined]


def _affinity() -> Any:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None


def _write_affinity(cores: Any) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)


def _decimal_settings() -> tuple[Any, ...]:
    """Return the arguments of a context like the present one, without flags: arithmetic sets them, and they decide nothing."""
    now = decimal.getcontext()
    traps = [signal for signal, is_on in now.traps.items() if is_on]
    return now.prec, now.rounding, now.Emin, now.Emax, now.capitals, now.clamp, [], traps


def _rounding() -> int:
    """Return the processor's rounding mode, of <fenv.h>."""
    return int(_C.fegetround()) if hasattr(_C, "fegetround") else 0


def _numpy_generator() -> tuple[Any, ...]:
    name, numbers, *rest = np.random.get_state()  # noqa: NPY002, the generator that a plugin may have used
    return (name, np.asarray(numbers).tobytes(), *rest)


def _write_numpy_generator(state: tuple[Any, ...]) -> None:
    np.random.set_state((state[0], np.frombuffer(state[1], dtype=np.uint32), *state[2:]))  # noqa: NPY002


_C = ctypes.CDLL(None)
SETTINGS = (
    Setting("the working folder", _working_folder, os.chdir),
    Setting("environment variables", _environment, _write_environment, names_parts=True),
    Setting("the locale", lambda: locale.setlocale(locale.LC_ALL), lambda text: locale.setlocale(locale.LC_ALL, text)),
    Setting("warnings as errors", _error_filters, _write_error_filters),
    Setting("the import path", lambda: list(sys.path), lambda paths: sys.path.__setitem__(slice(None), paths)),
    Setting("the recursion limit", sys.getrecursionlimit, sys.setrecursionlimit),
    Setting("garbage collection", gc.isenabled, lambda on: gc.enable() if on else gc.disable()),
    Setting("the processor cores", _affinity, _write_affinity),
    Setting("the rounding mode", _rounding, lambda mode: _C.fesetround(mode)),
    Setting("denormal numbers", lambda: SMALLEST * ONE != 0.0, lambda _: "torch" in sys.modules and _torch().set_flush_denormal(False)),
    Setting("the decimal context", _decimal_settings, lambda settings: decimal.setcontext(decimal.Context(*settings)), is_scoped=True),
    Setting("the seed of random", random.getstate, random.setstate),
    Setting("NumPy's error state", np.geterr, lambda state: np.seterr(**state), names_parts=True, is_scoped=True),
    Setting("NumPy's error handler", np.geterrcall, np.seterrcall, is_scoped=True),
    Setting("NumPy's buffer size", np.getbufsize, np.setbufsize, is_scoped=True),
    Setting("the seed of numpy.random", _numpy_generator, _write_numpy_generator),
    Setting("SciPy's error state", lambda: sys.modules["scipy.special"].geterr(), lambda state: sys.modules["scipy.special"].seterr(**state), "scipy.special", names_parts=True, is_scoped=True),
    Setting("the threads of scipy.fft", lambda: sys.modules["scipy.fft"].get_workers(), None, "scipy.fft"),
    Setting("JAX's configuration", _jax_settings, _write_jax, "jax", True, is_scoped=True),
    Setting("torch's default type", lambda: _torch().get_default_dtype(), lambda kind: _torch().set_default_dtype(kind), "torch"),
    Setting("torch's threads", lambda: _torch().get_num_threads(), lambda count: _torch().set_num_threads(count), "torch"),
    Setting("torch's gradients", lambda: _torch().is_grad_enabled(), lambda on: _torch().set_grad_enabled(on), "torch"),
    Setting("torch's deterministic algorithms", lambda: _torch().are_deterministic_algorithms_enabled(), lambda on: _torch().use_deterministic_algorithms(on), "torch"),
    Setting("torch's precision of matrix products", lambda: _torch().get_float32_matmul_precision(), lambda kind: _torch().set_float32_matmul_precision(kind), "torch"),
    Setting("torch's anomaly detection", lambda: _torch().is_anomaly_enabled(), lambda on: _torch().autograd.set_detect_anomaly(on), "torch"),
    Setting("the seed of torch", lambda: _torch().random.get_rng_state().numpy().tobytes(), lambda state: _torch().random.set_rng_state(_torch().frombuffer(bytearray(state), dtype=_torch().uint8)), "torch"),
)  # fmt: skip
"""The settings that decide numbers or how they are computed."""


class State:
    """The state of this process at one moment, to be compared with later ones.

    Imports of installed libraries are not changes: the state after such an import becomes part of this one. With
    ``double_precision``, JAX computes in float64 from its import on, so that its type does not depend on earlier cells.
    With ``single_thread``, libraries of linear algebra use one thread until :meth:`close`, also those imported later: the
    number of threads changes the order of sums.
    """

    def __init__(self, double_precision: bool = False, single_thread: bool = False) -> None:
        self._double_precision, self._single_thread = double_precision, single_thread
        self._limited: dict[str, tuple[Any, int]] = {}
        """The limited libraries by file, each with its earlier number of threads."""
        self._settings: dict[Setting, Any] = {}
        self._tables: dict[Any, dict[str, Any]] = {}
        """The names and values of each checked module and class."""
        self._libraries: list[Any] = []
        """The libraries of linear algebra and threads."""
        self._threads: list[int] = []
        self._earlier: list[str] = []
        """Changes found before an import changed the state further."""
        self._before: dict[Setting, Any] = {}
        """The scoped settings before the present import."""
        self.adopt()
        _ImportWatch.install()
        _ImportWatch.states.append(self)

    def close(self) -> None:
        """Stop following imports, and restore the numbers of threads."""
        for library, count in self._limited.values():
            library.set_num_threads(count)
        if self in _ImportWatch.states:
            _ImportWatch.states.remove(self)

    def adopt(self) -> None:
        """Take the present state as the one to compare with."""
        self._find_libraries()
        self._settings, self._tables, self._earlier = {}, {}, []
        self._add_new()

    def before_import(self) -> None:
        """Note the changes up to now and undo them, since the state after an import is adopted."""
        self._before = {item: item.read() for item in self._settings if item.is_scoped}
        self._earlier += [phrase for phrase in self.changes(scoped=False) if phrase not in self._earlier]
        if self._earlier:
            self.restore(scoped=False)

    def after_import(self) -> None:
        """Adopt what an import has changed, and add new modules.

        A setting that a ``with`` block may have set before the import is not adopted, since the block undoes it.
        """
        self._find_libraries()
        self._settings = {
            item: item.read() if before == self._settings[item] else self._settings[item]
            for item, before in self._before.items()
        }
        self._tables = {owner: before for owner, before in self._tables.items() if _is_equal(vars(owner), before)}
        self._add_new()

    def changes(self, functions: bool = True, scoped: bool = True) -> list[str]:
        """Return what has changed, as phrases such as ``NumPy's error state (divide)``.

        Without ``functions``, replaced functions of modules and classes are not searched for, which takes most of the time.
        Without ``scoped``, settings of ``with`` blocks are left out.
        """
        phrases = list(self._earlier)
        for item, before in self._settings.items():
            if item.is_scoped and not scoped:
                continue
            after = item.read()
            if after != before:
                parts = _changed_keys(before, after) if item.names_parts else []
                phrases.append(item.name + (f" ({_listed(parts)})" if parts else ""))
        if self._n_threads() != self._threads and "the threads of linear algebra" not in phrases:
            phrases.append("the threads of linear algebra")
        return [*phrases, *(self._replaced_functions() if functions else ())]

    def restore(self, scoped: bool = True) -> None:
        """Restore this state, as far as it can be restored; without ``scoped``, settings of ``with`` blocks are left."""
        self._restore_functions()
        for item, value in self._settings.items():
            with suppress(Exception):
                if item.write is not None and (scoped or not item.is_scoped) and item.read() != value:
                    item.write(value)
        for library, count in zip(self._libraries, self._threads, strict=True):
            with suppress(Exception):
                if library.get_num_threads() != count:
                    library.set_num_threads(count)

    def _replaced_functions(self) -> list[str]:
        """Return the replaced functions as one phrase; empty if there are none."""
        replaced = [f"{_name(owner)}.{name}" for owner, name in self._replaced()]
        return [_listed(replaced)] if replaced else []

    def _restore_functions(self) -> None:
        for owner, name in list(self._replaced()):
            with suppress(Exception):
                if name in self._tables[owner]:
                    setattr(owner, name, self._tables[owner][name])
                else:
                    delattr(owner, name)

    def _add_new(self) -> None:
        """Add the settings and names of libraries and modules that are not recorded yet."""
        is_new = not any(item.library == "jax" for item in self._settings)  # an import after a change may not undo it unnamed
        if self._double_precision and is_new and reduced_precision():
            _jax().config.update("jax_enable_x64", True)
        for item in SETTINGS:
            if item not in self._settings and (not item.library or _is_imported(sys.modules.get(item.library))):
                self._settings[item] = item.read()
        for owner in _owners():
            if owner not in self._tables:
                self._tables[owner] = dict(vars(owner))

    def _find_libraries(self) -> None:
        self._libraries = ThreadpoolController().lib_controllers
        for library in self._libraries if self._single_thread else ():
            self._limited.setdefault(library.filepath, (library, library.get_num_threads()))
            library.set_num_threads(1)
        self._threads = self._n_threads()

    def _n_threads(self) -> list[int]:
        return [library.get_num_threads() for library in self._libraries]

    def _replaced(self) -> Iterator[tuple[Any, str]]:
        """Yield each module or class with the name of a function or constant that was replaced, removed or hidden."""
        for owner, before in self._tables.items():
            after = vars(owner)
            if _is_equal(after, before):
                continue
            names = [
                name for name, value in before.items() if after.get(name, MISSING) is not value and _decides(value)
            ]
            added = (name for name in after.keys() - before.keys() if not isinstance(after[name], ModuleType))
            names += [name for name in added if _hides(owner, name)]
            yield from ((owner, name) for name in names)
            if not names:  # only names were added, such as modules that are imported when they are first used
                self._tables[owner] = dict(after)


@contextmanager
def undo_changes(source: str) -> Iterator[None]:
    """Undo what code in the block changes, and print it on one line of stderr."""
    state = State()
    try:
        yield
    finally:
        changes = state.changes()
        state.restore()
        state.close()
        if changes:
            print(f"bench: {source} changed {printable('; '.join(changes))}, which was undone", file=sys.stderr)


def reduced_precision() -> bool:
    """Return whether JAX computes in float32, whatever type a plugin asks for."""
    jax = sys.modules.get("jax")
    return _is_imported(jax) and not jax.config.jax_enable_x64  # type: ignore[union-attr]


def _owners() -> Iterator[Any]:
    """Yield the modules and classes whose names are checked."""
    for name in MODULES:
        module = sys.modules.get(name)
        if _is_imported(module):
            yield module
            for title in CLASSES.get(name, ()):
                yield getattr(module, title)
    for name, module in list(sys.modules.items()):
        if name.startswith(OWN) and _is_imported(module):
            yield module
            for value in list(vars(module).values()):
                if isinstance(value, type) and value.__module__ == name:
                    yield value


def _is_imported(module: Any) -> bool:
    """Return whether a module is completely imported."""
    return isinstance(module, ModuleType) and not getattr(module.__spec__, "_initializing", False)


def _decides(value: Any) -> bool:
    """Return whether a value of a module or class is a function, a type or a constant. Integers may be counters."""
    return callable(value) or isinstance(
        value, float | str | tuple | frozenset | ModuleType | property | staticmethod | classmethod
    )


def _hides(owner: Any, name: str) -> bool:
    """Return whether a name added to a class or module hides a base class's or a built-in name."""
    if isinstance(owner, type):
        return not name.startswith("_") and any(name in vars(base) for base in owner.__mro__[1:])
    return name in vars(builtins) and not name.startswith("_")


def _is_equal(after: Any, before: Any) -> bool:
    """Return whether two tables are equal; values that cannot be compared count as different."""
    try:
        return bool(after == before)
    except Exception:
        return False


def _name(owner: Any) -> str:
    return str(owner.__name__) if isinstance(owner, ModuleType) else f"{owner.__module__}.{owner.__qualname__}"


def _changed_keys(before: Mapping[Any, Any], after: Mapping[Any, Any]) -> list[str]:
    names = [name for name in before.keys() | after.keys() if before.get(name, MISSING) != after.get(name, MISSING)]
    return sorted(os.fsdecode(name) for name in names)


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + rest


# ------------------------------------------------------------------------------------------------------- imports


class _ImportWatch(importlib.abc.MetaPathFinder):
    """Reports the imports of installed libraries to the states that follow them; finds no module itself."""

    states: list[State] = []
    is_active = False

    @classmethod
    def install(cls) -> None:
        if not any(isinstance(finder, cls) for finder in sys.meta_path):
            sys.meta_path.insert(0, cls())

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Return the spec that the other finders find, with a loader that reports an outermost import."""
        if self.is_active or not self.states or name.startswith(("bench.", "bench_folder_")):
            return None
        finders = (finder for finder in sys.meta_path if finder is not self and hasattr(finder, "find_spec"))
        spec = next((spec for finder in finders if (spec := finder.find_spec(name, path, target)) is not None), None)
        if spec is None or not _is_installed(spec) or not hasattr(spec.loader, "__dict__"):
            return spec
        loader: Any = spec.loader
        execute = loader.exec_module

        def report(module: ModuleType) -> None:
            del loader.exec_module
            if _ImportWatch.is_active:
                execute(module)
                return
            for state in self.states:
                state.before_import()
            _ImportWatch.is_active = True
            try:
                execute(module)
            finally:
                _ImportWatch.is_active = False
                spec._initializing = False  # type: ignore[attr-defined]  # the module is complete, and its settings can be read
                for state in self.states:
                    state.after_import()

        loader.exec_module = report
        return spec


def _is_installed(spec: importlib.machinery.ModuleSpec) -> bool:
    """Return whether a module is in the standard library or an installed package."""
    return spec.origin is None or "site-packages" in spec.origin or spec.origin.startswith(STANDARD_LIBRARY)
