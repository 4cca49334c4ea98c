"""Records what code from outside reads: modules, files, installed packages and variables of the environment.

A row counts only while all of these are unchanged. Modules are those in ``sys.modules``. An audit hook sees other files,
but not those that a library opens in C or that another process opens: a plugin names them in ``files()``. Libraries that
were installed from an index count by their version, all other modules by content. Files that this process has written,
caches, devices and new files in the folder of temporary files do not count.
"""

from __future__ import annotations

import hashlib
import json
import os
import site
import stat
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions
from pathlib import Path
from typing import Any

OWN = "bench"
"""The package whose code counts by its revisions."""
SET_BY_RUNS = frozenset(
    (
        "BENCH_MARK",
        "BENCH_TRIAL",
        "JAX_ENABLE_X64",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NPROC",
    )
)
"""Variables that a run sets in its workers."""
_SITES = (*site.getsitepackages(), site.getusersitepackages())
LIBRARY_PATHS = tuple(f"{place}/" for folder in _SITES for place in (folder, os.path.realpath(folder)))
"""Starts of the paths of installed libraries."""
PACKAGE_FOLDER = Path(__file__).parents[1]
INSIDE = (
    *LIBRARY_PATHS,
    f"{PACKAGE_FOLDER}/",
    f"{PACKAGE_FOLDER.parent}/plugins/",
    f"{os.path.dirname(sysconfig.get_path('stdlib'))}/",
    "<frozen",
)
"""Starts of the paths of code that is not from outside: libraries, this package with its plugins, the standard library."""
IGNORED = ("/dev/", "/proc/", "/sys/", *INSIDE)
CACHES = ("/__pycache__/", "/.cache/", os.environ.get("XDG_CACHE_HOME") or "/.cache/")
STARTED_NS = time.time_ns()

_read: dict[str, str] = {}
"""Hashes by absolute path, versions by ``package NAME``, and hashes of values by ``$NAME``; empty for what there is not."""
_stamps: dict[str, tuple[int, ...]] = {}
_texts: list[str] = []
"""The manifest, while nothing is added."""
_written: set[str] = set()
_modules: set[str] = set()
_packages: set[str] = set()
_plugins: set[str] = set()
"""Top-level packages of plugins, which are from outside wherever they are installed."""
_folders: list[str] = []
_listed: list[str] = []
"""The names of variables that were listed last, whose values are copied next."""


def start(folder: str = "", plugin: str = "") -> None:
    """Record from now on. The files in ``folder`` are not temporary, and the module ``plugin`` is from outside."""
    _plugins.add(plugin.partition(".")[0])
    if not _folders:
        sys.addaudithook(_hear)
        os.environ.__class__ = _Environment
    if folder not in _folders:
        _folders.append(folder)


def note(path: str | Path) -> None:
    """Record a file as it is now."""
    path = os.path.abspath(path)
    stamp: tuple[int, ...] = ()
    with suppress(OSError):
        status = os.stat(path)
        stamp = status.st_mtime_ns, status.st_size, status.st_ino
    if path not in _read or _stamps.get(path) != stamp:
        _stamps[path] = stamp
        _add(path, hash_of(path))


def include(reads: str) -> None:
    """Record what a stored result that is used here has read."""
    for name, content in json.loads(reads or "{}").items():
        _add(_path_of(name), content)


def manifest() -> str:
    """Return all that has been read as JSON, names with hashes; empty if there is nothing."""
    if len(sys.modules) != len(_modules):
        new = [(name, module) for name, module in [*sys.modules.items()] if name not in _modules]
        _modules.intersection_update(sys.modules)
        for name, module in new:
            _modules.add(name)
            with suppress(Exception):  # a module may be an object of any kind
                _note_module(name, module)
    while _packages:
        with suppress(PackageNotFoundError):
            _note_package(_packages.pop())
    if not _texts:
        counted = {name_of(path): content for path, content in [*_read.items()] if path not in _written}
        _texts.append(json.dumps(counted, sort_keys=True) if counted else "")
    return _texts[0]


def hash_of(path: str | Path) -> str:
    """Return the hash of a file's content; empty if there is no such file."""
    with suppress(OSError):
        if stat.S_ISREG(os.stat(path).st_mode):
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
    return ""


class Present:
    """What is there now, read once: files, packages, and the variables of an environment."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment
        self._found: dict[str, str] = {}
        self._changes: dict[tuple[str, str], str] = {}

    def change(self, reads: str, versions: str = "") -> str:
        """Return what has changed since a result read it, with both hashes; empty if nothing has.

        Libraries in ``versions``, as ``numpy=2.4;jax=0.9``, are not compared.
        """
        given = reads, versions
        if given not in self._changes:
            self._changes[given] = self._change(reads, {part.partition("=")[0] for part in versions.split(";")})
        return self._changes[given]

    def _change(self, reads: str, ignored: set[str]) -> str:
        try:
            read = dict(json.loads(reads or "{}"))
        except (ValueError, TypeError, RecursionError):
            return "the record of what it has read is damaged"
        for name, before in read.items():
            if name not in self._found:
                self._found[name] = self._now(name)
            now = self._found[name]
            if now != before and name.removeprefix("package ") not in ignored:
                return f"{name} changed: {now[:8] or 'none'} for {str(before)[:8] or 'none'}"
        return ""

    def _now(self, name: str) -> str:
        if name.startswith("$"):
            return _hash_of_value(self._environment.get(name[1:]))
        if name.startswith("package "):
            with suppress(PackageNotFoundError, ValueError):
                return distribution(name.removeprefix("package ")).version
            return ""
        return hash_of(_path_of(name))


def name_of(path: str) -> str:
    """Return a path as it is stored: below a folder of plugins ``<FOLDER>/FILE``, so that the folder may be moved."""
    folder = next((folder for folder in _folders if folder and path.startswith(f"{folder}/")), "")
    return f"<{os.path.basename(folder)}>{path.removeprefix(folder)}" if folder else path


def _path_of(name: str) -> str:
    base, _, rest = name.removeprefix("<").partition(">")
    found = [folder + rest for folder in _folders if rest and os.path.basename(folder) == base]
    return next(filter(os.path.exists, found), name)


def _add(name: str, content: str) -> None:
    if _read.get(name) != content:
        # a file that has changed while it was in use counts as one whose hash no content has
        _read[name] = "several contents" if name in _read else content
        _texts.clear()


def _hash_of_value(value: str | None) -> str:
    return "" if value is None else hashlib.sha256(os.fsencode(value)).hexdigest()


def _note_module(name: str, module: Any) -> None:
    """Record the file of a module from outside, unless it counts by its revision, and the libraries that it uses."""
    file, parts = module.__file__, name.split(".")
    if not _is_outside(name, file):
        return
    if file.startswith(LIBRARY_PATHS):
        _packages.add(parts[0])
    packages = [sys.modules.get(".".join(parts[: n + 1])) for n in range(len(parts))]
    if not any(getattr(package, "REVISION", 0) for package in packages):
        note(file)
    for value in [*vars(module).values()]:
        origin = getattr(value, "__name__" if isinstance(value, type(sys)) else "__module__", None)
        _packages.add(str(origin).partition(".")[0])


def _note_package(top: str) -> None:
    """Record the version of a library, or the content of its modules if it was installed from a folder."""
    if str(getattr(sys.modules.get(top), "__file__", "")).startswith(LIBRARY_PATHS):
        library = _distribution_of(top)
        _add(f"package {library.name}", library.version)
        if '"file:' in (library.read_text("direct_url.json") or ""):
            for name, module in [*sys.modules.items()]:
                file = getattr(module, "__file__", None)
                if file and name.partition(".")[0] == top:
                    note(file)


def _distribution_of(top: str) -> Distribution:
    try:
        return distribution(top)
    except PackageNotFoundError:  # a module may have another name than its distribution
        return distribution(_distributions().get(top, [top])[0])


_distributions = cache(packages_distributions)


def _is_outside(name: str, file: str) -> bool:
    top = name.partition(".")[0]
    is_inside = top in (OWN, "__main__") or top in sys.stdlib_module_names or file.startswith(INSIDE)
    return top in _plugins or not is_inside


def _is_from_outside(through_libraries: bool) -> bool:
    """Return whether code from outside, which this package has called, asks: directly, or also through libraries."""
    frame, is_outside = sys._getframe(1), False
    while frame.f_back is not None:
        frame = frame.f_back
        name, file = str(frame.f_globals.get("__name__")), frame.f_code.co_filename
        if name.partition(".")[0] == OWN:
            return is_outside
        is_outside = is_outside or _is_outside(name, file)
        if not (is_outside or through_libraries) and file.startswith(LIBRARY_PATHS):
            return False
    return is_outside and threading.current_thread() is not threading.main_thread()


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if event not in ("open", "os.rename", "import"):
        return
    with suppress(Exception):  # an error would reach the code that is heard
        if event == "import":
            if _is_from_outside(False):
                _packages.add(arguments[0].partition(".")[0])
            return
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if event == "os.rename":
            if path in _written:
                _written.add(os.path.abspath(os.fsdecode(arguments[1])))
        elif arguments[2] & os.O_ACCMODE != os.O_RDONLY:
            _written.add(path)
            _texts.clear()
        elif path not in _written and _is_from_outside(True) and _is_input(path):
            note(path)


def _is_input(path: str) -> bool:
    """Return whether a file counts: it belongs to no library or cache and, among temporary files, it is not new."""
    if path.startswith(IGNORED) or any(cache in path for cache in CACHES):
        return False
    is_kept = not path.startswith(f"{tempfile.gettempdir()}/") or path.startswith(tuple(filter(None, _folders)))
    return is_kept or not os.path.exists(path) or os.stat(path).st_ctime_ns < STARTED_NS


class _Environment(os._Environ[str]):
    """The variables of the environment; records those that code from outside asks for by name, before it sets them."""

    def __iter__(self) -> Iterator[str]:
        _listed[:] = super().__iter__()
        return iter([*_listed])

    def __getitem__(self, key: str) -> str:
        name, value = f"${key}", None
        with suppress(KeyError):
            value = super().__getitem__(key)
        if _listed and _listed.pop(0) == key:  # all are copied
            pass
        elif not (name in _read or name in _written or key in SET_BY_RUNS) and _is_from_outside(False):
            _add(name, _hash_of_value(value))
        if value is None:
            raise KeyError(key) from None
        return value

    def __setitem__(self, key: str, value: str) -> None:
        super().__setitem__(key, value)
        if f"${key}" not in _read:
            _written.add(f"${key}")
