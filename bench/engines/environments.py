"""The environments of engines: their folders, their installation, and the versions of the libraries in them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.errors import Unavailable, UserError, printable
from bench.host.parameters import remember

FOLDER = "BENCH_ENGINES"
"""Environment variable with the folder that contains the environments."""
PRINT_VERSIONS = """
import importlib.metadata, json, platform, sys
found = {"python": platform.python_version()}
for name in sys.argv[1:]:
    try:
        found[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        pass
print(json.dumps(found))
"""


def folder() -> Path:
    """Return the folder that contains the environments: ``$BENCH_ENGINES``, otherwise a folder in the user's cache."""
    if given := os.environ.get(FOLDER):
        return Path(given).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return (Path(cache) / "diffsim-bench" / "engines").expanduser()


def python_of(engine: str) -> Path:
    """Return the Python of an engine's environment, which may not exist."""
    return folder() / engine / "bin" / "python"


@remember
def library_versions(python: str, libraries: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of Python and of the installed libraries of another Python, by name.

    Raises :class:`Unavailable` if it is not a Python.
    """
    words = [python, "-I", "-c", PRINT_VERSIONS, *libraries]
    try:
        # seconds allowed for a Python to state its versions
        done = subprocess.run(words, capture_output=True, timeout=60.0, stdin=subprocess.DEVNULL)
        return {str(name): str(version) for name, version in json.loads(done.stdout).items()}
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Unavailable(f"it cannot be started ({printable(error)[:200]})") from error
    except ValueError:
        output = printable((done.stderr or done.stdout).decode(errors="replace"))[-200:]
        raise Unavailable(f"it is not a working Python (its output: {output or 'none'})") from None


def missing(engine: str, python: str | None, libraries: Sequence[str]) -> str | None:
    """Return why an engine's environment cannot be used, with the command that makes it; None if it can."""
    path = str(python or python_of(engine))
    make = f"make its environment with `python -m bench engines install {engine}`"
    try:
        if not Path(path).exists():
            raise Unavailable("the file does not exist" if python else "it is not installed")
        versions = library_versions(path, tuple(libraries))
    except Unavailable as error:
        where = f"python={path}" if python else f"engine {engine}"
        return f"{where}: {error}; {make}"
    absent = [name for name in libraries if name not in versions]
    return f"python={path} has no {', '.join(absent)}; {make}" if absent else None


def install(engine: str, requirements: Path, again: bool = False) -> Path:
    """Make an engine's environment from a file of requirements, and return its folder.

    ``NAME==VERSION`` is an environment of its own with another release of the file's first distribution, or the newest
    (``NAME==newest``), and what pip chooses for it. An environment that exists is completed, or with ``again`` made from
    the start. Raises :class:`UserError` if pip fails; then a new folder is removed.
    """
    place, release = folder() / engine, engine.partition("==")[2]
    if again and place.exists():
        shutil.rmtree(place)
    is_new = not place.exists()
    wanted, distribution = ["-r", str(requirements)], requirements.read_text().partition("==")[0]
    if release:
        # the release that pip chooses without a pin
        wanted = ["--upgrade", distribution] if release == "newest" else [f"{distribution}=={release}"]
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        if is_new:
            subprocess.run([sys.executable, "-m", "venv", str(place)], check=True)
        pip = [str(place / "bin" / "python"), "-m", "pip", "install", "--disable-pip-version-check", "--quiet"]
        subprocess.run([*pip, *wanted], check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        if is_new:
            shutil.rmtree(place, ignore_errors=True)
        raise UserError(f"the environment of engine {engine} cannot be made in {place}: {error}") from error
    library_versions.cache_clear()  # type: ignore[attr-defined]
    return place
