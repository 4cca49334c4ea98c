"""Imports go one way, type-checking imports too: no circle, no arrow upwards, and plugins see only the contracts."""

import ast
import graphlib
import re
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

from bench import model

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "bench"
LAYERS = [
    ["errors"],
    ["simulator", "host"],
    ["model"],
    ["engines"],
    ["measure", "plugins"],
    ["training", "gradient"],
    ["experiment", "conformance"],
    ["run"],
    ["report"],
    ["trace"],
    ["compare", "examine", "claims"],
    ["notebook", "plugin"],
    ["api"],
    ["__init__"],
    ["cli"],
    ["__main__"],
]
"""The packages of ``bench``, each importing only from those above it in this list."""
FILES = sorted(BENCH.rglob("*.py"))
PLUGINS = sorted((ROOT / "plugins").rglob("*.py"))


def module_of(path):
    """``bench.report.tables`` of its file, ``bench.report`` of the ``__init__.py``."""
    base = "bench.plugins" if (ROOT / "plugins") in path.parents else ""
    parts = path.relative_to(ROOT / "plugins" if base else ROOT).with_suffix("").parts
    return ".".join(filter(None, [base, *(part for part in parts if part != "__init__")]))


@cache
def imported(path):
    """Every module and name that a file imports, at its top, later, or for types only, as ``bench.experiment.cell.Cell``."""
    return list(_imported(path))


def _imported(path):
    own = module_of(path)
    parent = own if path.name == "__init__.py" else own.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), parent)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def package(name):
    """``report`` of ``bench.report.tables``; ``__init__`` of a name that ``bench`` itself offers."""
    part = name.split(".")[1] if "." in name else "__init__"
    return part if any(part in layer for layer in LAYERS) else "__init__"


HEIGHT = {name: index for index, layer in enumerate(LAYERS) for name in layer}


def test_imports_go_down():
    for path in FILES:
        own = package(module_of(path)) if path.parent != BENCH else path.stem
        assert own in HEIGHT, f"say in LAYERS where bench/{own} belongs"
        check_imports(path, own)


def check_imports(path, own):
    for name in imported(path):
        assert name.partition(".")[0] != "plugins", f"bench knows no plugin by name, and {path} imports {name}"
        if name.partition(".")[0] == "bench":
            there = package(name)
            if there == "plugins":
                assert own == "plugins", f"bench knows no plugin by name, and {path} imports {name}"
            assert there == own or HEIGHT[there] < HEIGHT[own], (
                f"{path} imports {name}, which stands beside or above it"
            )


def graph():
    """Modules, and those of the package that each imports."""
    modules = {module_of(path): path for path in FILES}
    found = {}
    for name, path in modules.items():
        taken = {inner if inner in modules else inner.rpartition(".")[0] for inner in imported(path)}
        found[name] = {other for other in taken if other in modules and other not in (name, "bench")}
    return found


def test_no_modules_import_each_other_in_a_circle():
    """Nor a module the package that it is part of, where the package imports it."""
    graphlib.TopologicalSorter(graph()).prepare()  # raises CycleError with the circle


TOPS = {"studies": "report"}
"""Kinds of plugins that stand on more than the contracts, and the highest package that they import."""


def test_plugins_import_only_public_names():
    for path, name in [(file, found) for file in PLUGINS for found in imported(file)]:
        kind = path.relative_to(ROOT / "plugins").parts[0]
        if kind in TOPS and name.partition(".")[0] == "bench":
            own = name.startswith(f"bench.plugins.{kind}")
            assert own or (package(name) != "plugins" and HEIGHT[package(name)] <= HEIGHT[TOPS[kind]]), (
                f"{path} imports {name}"
            )
        elif name.startswith("bench.plugins"):
            family = path.parent.name == "backends" or path.parent == ROOT / "plugins"
            family = family or (ROOT / "plugins" / f"{name.split('.')[2]}.py").is_file()  # a module that kinds share
            family = family or (path.parent.name, name.split(".")[2]) == ("trainers", "optimizers")  # both search
            assert family or name.split(".")[2] == path.parent.name, f"{path.name} imports {name} of another kind"
        elif name.startswith("bench.training."):
            assert path.parent.name == "trainers", f"{path.name} imports {name}, which is for trainers"
        elif name.startswith("bench.claims."):
            assert path.parent.name == "claims", f"{path.name} imports {name}, which is for claims"
        elif name.startswith("bench.engines.conformance."):
            assert path.stem.endswith("_conformance"), f"{path.name} imports {name}, which is for the conformance set"
        elif name.partition(".")[0] == "bench" and name.rpartition(".")[0] != "bench.engines.backend":
            assert name.rpartition(".")[0] == "bench.model", f"a plugin imports bench.model, not {name}"
            assert name.rpartition(".")[2] in model.__all__, f"{name} is not in bench.model.__all__"


HOMONYMS = {
    "jax",
    "torch",
    "numpy",
    "mujoco",  # libraries
    "mjcf",  # a file format
    "clipped",
    "constant",
    "linear",
    "plain",
    "growth",
    "solver",
    "engines",  # words of the contracts, of a verb or of English
}
"""Names of plugins that the core uses for something else."""
NAMED = {
    "api.py": {"penalty", "semi_implicit_euler"},  # defaults of `bench.problem`, as in the configuration
    "cli.py": {"gradient_check", "penalty"},  # the study of a verb, and what it runs on scenes of engines
    "engines/backend.py": {
        "penalty",
        "semi_implicit_euler",
    },  # what an engine's contacts and steps stand for by default
    "trace/contacts.py": {"implicit"},
    "claims/toolkit.py": {"penalty", "semi_implicit_euler", "fused", "gradient_descent", "reinforce", "fobg"},
    "claims/tables.py": {"fobg", "reinforce", "measure_valued", "randomized_smoothing", "sphere_smoothing"},
}
"""The files that name plugins, and which: defaults of a function or verb, and what claims share."""


def test_the_core_names_no_plugin():
    """Everywhere in ``bench``, alone, as ``name[..]`` or in a list: plugins and studies are known through the registry."""
    from bench.model import registry

    names = {name for table in registry.entries().values() for name in table} - HOMONYMS
    found = {path: {*_names_in(path)} & names for path in FILES if "conformance" not in path.parts}
    found = {path.relative_to(BENCH).as_posix(): some for path, some in found.items() if some}
    assert found == NAMED


def _names_in(path):
    """The words of a file's strings that stand where a plugin's name can: docstrings and prose are left out."""
    tree = ast.parse(path.read_text())
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield from re.findall(r"(?:^|[=\[,])([a-z0-9_]+)(?=$|[\[\],])", node.value)
