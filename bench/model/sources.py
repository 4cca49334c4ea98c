"""What a result depends on: hashes of the parsed source of modules that ignore docstrings and comments."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from bench.model.parameters import Plugin, remember

PACKAGES = ("bench.plugins",)
"""Subpackages that count as packages of their own: what built-in plugins import from ``bench`` belongs to the core."""


@remember
def source_hash(plugin: type[Plugin]) -> str:
    """Return the hash of a plugin's code: its own module and those it imports from its own package."""
    return hash_of(sources(plugin.__module__))


def hash_of(paths: Iterable[Path]) -> str:
    """Return the hash of the code in files, ignoring their names, docstrings and comments."""
    digest = hashlib.sha256()
    for code in sorted(code_hash(path) for path in paths):
        digest.update(code.encode())
    return digest.hexdigest()


@remember
def code_hash(path: Path) -> str:
    """Return the hash of a file's syntax tree without docstrings, so that rewording one reruns no cell."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # a body of only a docstring becomes `pass`, as if it had been written that way
            kept = [part for part in body if not _is_text(part)]
            node.body = kept or [ast.Pass()]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is a string on its own: a docstring, also one of an attribute."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def sources(module: str, without: Collection[str] = ()) -> set[Path]:
    """Return the files of a module and of all its imports from its own package, except modules under ``without``."""
    paths: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        skipped = name in paths or any(name == other or name.startswith(f"{other}.") for other in without)
        path = None if skipped else _file(name)
        if path is not None:
            paths[name] = path
            waiting.extend(_imports(name, path))
    return set(paths.values())


def _imports(module: str, path: Path) -> Iterator[str]:
    """Yield names a file imports from its package; ``from a import b`` may mean module ``a.b`` or a name in ``a``."""
    package = next((p for p in PACKAGES if module.startswith(f"{p}.")), module.partition(".")[0])
    parent = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), parent)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        yield from (name for name in names if f"{name}.".startswith(f"{package}."))


@remember
def _file(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    origin = spec.origin if spec is not None else None
    return Path(origin) if origin is not None and origin.endswith(".py") else None
