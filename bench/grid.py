"""From an experiment's axes to cells, and what makes two cells the same."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from bench import registry
from bench.contracts import Backend, ContactLaw, Estimator, Integrator, MechanicalScene, Plugin, Scene, Unsupported
from bench.errors import UserError, failure, unknown
from bench.program import Program

AXES = {
    "scene": "scenes",
    "contact": "contacts",
    "integrator": "integrators",
    "backend": "backends",
    "estimator": "estimators",
}
"""Configuration groups of plugin parameters, and the kinds they belong to."""
COUNTS = ("samples", "repeats", "seed")
"""What a sweep can vary beside plugin parameters."""
OWN_COLUMNS = ("horizon", "dt", "sigma", "stiffness", "noise", "dtype")
"""Plugin parameters that have a column of their own and so are left out of identity strings."""


@dataclass(frozen=True)
class Choice:
    """A plugin chosen on an axis, with the parameters its identity string set."""

    entry: registry.Entry
    values: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Execution:
    """How cells are run; decides none of their numbers."""

    workers: int | None = None
    """Processes at once; None for the number of cores, 0 for none beside this one."""
    timeout: float | None = None
    """Seconds that a cell may take."""
    memory: int | None = None
    """Bytes that a worker may hold."""
    stop: bool = False
    """Whether the first failed cell ends the run."""
    versions: str = "warn"
    """What is done about stored rows that other library versions have made: ``ignore``, ``warn`` or ``rerun``."""
    retry: tuple[str, ...] = ()
    """Statuses of stored rows that are run again."""


@dataclass(frozen=True)
class Experiment:
    """A named sweep, resolved from configuration."""

    name: str
    choices: Mapping[str, Sequence[Choice]]
    values: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    """Parameters set for plugins by group (``scene``, ...), plugin name and parameter."""
    sweep: Mapping[str, Any] = field(default_factory=dict)
    samples: int = 256
    repeats: int = 64
    seed: int = 0
    results_dir: Path = Path("results")
    question: str = ""
    study: str = "bias_variance"
    """What is measured of each cell."""
    marks: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Per axis, named values to draw as lines in the charts."""
    compile_time: bool = False
    """Whether charts of error against time add compilation to it."""
    reference_samples: int = 1 << 18
    reference_tolerance: float = 0.005
    compile_cache: Path | None = None
    """Where compiled programs are kept between runs."""
    timing: bool | None = None
    """Whether cells are timed, each alone on the machine; None for what the study asks for."""
    referenced: bool = True
    """Whether the study holds its cells to the reference gradient."""
    execution: Execution = Execution()

    @property
    def budget(self) -> tuple[int, float] | None:
        """Most samples of a reference and the tolerance at which it stops; None where the study has no reference."""
        return (self.reference_samples, self.reference_tolerance) if self.referenced else None

    @property
    def directory(self) -> Path:
        """Where the experiment's files lie."""
        return self.results_dir / self.name


@dataclass(frozen=True)
class Cell:
    """One point of a sweep: a problem, an estimator, counts and a seed."""

    scene: Scene
    contact: ContactLaw | None
    integrator: Integrator | None
    backend: Backend
    estimator: Estimator
    samples: int
    repeats: int
    seed: int
    study: str = "bias_variance"
    timing: bool = True
    """Whether the times it takes are numbers of its row."""
    budget: tuple[int, float] | None = None
    """Most samples of its reference and the tolerance at which it stops; None where there is no reference."""

    @property
    def parts(self) -> tuple[Plugin | None, ...]:
        """The five plugins; None where the scene has no such axis."""
        return (self.scene, self.contact, self.integrator, self.backend, self.estimator)

    @cached_property
    def key(self) -> str:
        """Hash of everything that decides the cell's numbers; library versions are columns instead."""
        counts = [self.samples, self.repeats, self.seed, self.timing]
        reference = None if self.budget is None else self.reference_key
        return _hashed([fingerprint(p) for p in self.parts], counts, reference, core_hash(), study_hash(self.study))

    @cached_property
    def program_key(self) -> str:
        """Hash of everything that decides the program."""
        return _program_key(*(fingerprint(p) for p in self.parts[:3]))

    @cached_property
    def reference_key(self) -> str:
        """Hash of everything that decides the reference gradient; raises ValueError for a cell without reference."""
        if self.budget is None:
            raise ValueError("a study that is held to references has a column reference_method")
        return _reference_key(self.program_key, self.budget, fingerprint(self.reference_backend))

    @cached_property
    def reference_backend(self) -> Backend:
        """The backend that computes the reference gradient."""
        return next(reference_backends(self))

    def program(self) -> Program:
        """The program; raises :class:`Unsupported` for a combination without meaning."""
        return Program(self.scene, self.contact, self.integrator)

    def columns(self) -> dict[str, Any]:
        """The identity columns of the cell's row."""
        contact = None if self.contact is None else type(self.contact)
        smoothing = math.nan
        given = dict(self.scene.contact_values) if isinstance(self.scene, MechanicalScene) else {}
        if contact is not None and contact.smoothing:
            smoothing = getattr(self.contact, contact.smoothing)
        stiffness = getattr(self.contact, "stiffness", getattr(self.scene, "stiffness", math.nan))
        return {
            "scene": label(self.scene),
            "contact": label(self.contact, {**given, **({contact.smoothing: smoothing} if contact else {})}),
            "integrator": label(self.integrator),
            "backend": label(self.backend),
            "estimator": self.estimator.name,
            "estimator_params": registry.identity("", changed(self.estimator)).strip("[]"),
            "noise": self.scene.noise,
            "horizon": getattr(self.scene, "horizon", 0),
            "dt": getattr(self.scene, "dt", math.nan),
            "stiffness": stiffness,
            "sigma": self.scene.sigma,
            "smoothing": smoothing,
            "samples": self.samples,
            "repeats": self.repeats,
            "dim": self._dim(),
            "seed": self.seed,
            "dtype": self.backend.dtype,
            "key": self.key,
        }

    def _dim(self) -> float:
        try:
            return int(self.scene.theta0().size)
        except Exception:  # the cell's own row will say so
            return math.nan

    def refusal(self) -> tuple[str, str] | None:
        """Status and reason why this cell cannot run, or None."""
        try:
            return self._refusal()
        except Exception as error:
            found = failure(error)
            return found["status"], found["reason"]

    def _refusal(self) -> tuple[str, str] | None:
        for part in self.parts:
            if part is not None:
                entry = registry.find(part.kind, part.name)
                if not entry.available:
                    return "unavailable", f"{part.kind.removesuffix('s')} {part.name} is {entry.reason}"
        try:
            program = self.program()
        except Unsupported as error:
            return "unsupported", str(error)
        backend, estimator = self.backend, self.estimator
        if "physics" in backend.provides and (reason := backend.refuses(program)):
            return "unsupported", reason
        if program.needs_root and "root" not in backend.provides:
            part = next(p for p in (self.contact, self.integrator) if p is not None and p.needs_root)
            return "unsupported", f"{part.name} solves an equation each step, backend {backend.name} has no root finder"
        if not program.needs <= backend.provides:
            return "unsupported", f"{self.scene.name} runs in physics engines alone, backend {backend.name} is none"
        lacking = estimator.needs - backend.provides
        if lacking:
            return "unsupported", f"{estimator.name} needs {', '.join(sorted(lacking))}, which {backend.name} lacks"
        reason = backend.refuses(program) or estimator.refuses(program)
        return ("unsupported", reason) if reason else None


def changed(plugin: Plugin, given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Parameters that differ from their defaults, or from ``given``."""
    given = given or {}
    table = registry.parameters(type(plugin))
    return {
        name: getattr(plugin, name)
        for name, parameter in table.items()
        if getattr(plugin, name) != given.get(name, parameter.default)
    }


def label(plugin: Plugin | None, given: Mapping[str, Any] | None = None) -> str:
    """Identity string of a plugin, without the parameters that have their own column; ``none`` for no plugin."""
    if plugin is None:
        return "none"
    values = {k: v for k, v in changed(plugin, given).items() if k not in OWN_COLUMNS}
    return registry.identity(plugin.name, values)


_fingerprints: dict[int, tuple[Plugin, str]] = {}
"""By identity, since equal plugins may differ in their numbers: -0.0 equals 0.0, and False 0."""
_ranked: dict[str, list[Backend]] = {}


def fingerprint(plugin: Plugin | None) -> str:
    """Hash of kind, name, parameters and source of a plugin, as JSON: floats to their last bit, texts in quotes."""
    if plugin is None:
        return ""
    if id(plugin) not in _fingerprints:
        values = {name: getattr(plugin, name) for name in sorted(registry.parameters(type(plugin)))}
        text = json.dumps([plugin.kind, plugin.name, values, registry.source_hash(type(plugin))], default=repr)
        _fingerprints[id(plugin)] = (plugin, hashlib.sha256(text.encode()).hexdigest())
    return _fingerprints[id(plugin)][1]


def _hashed(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


@registry.remember
def _program_key(scene: str, contact: str, integrator: str) -> str:
    return _hashed(scene, contact, integrator, core_hash())


@registry.remember
def _reference_key(program: str, budget: tuple[int, float], backend: str) -> str:
    return _hashed(program, budget, backend)


@registry.remember
def core_hash() -> str:
    """Hash of the harness's own files that decide numbers whatever is measured."""
    names = ("contracts", "noise", "program", "reference", "statistics")
    return registry.hash_of(Path(__file__).with_name(f"{name}.py") for name in names)


BOOKKEEPING = tuple(
    f"bench.{name}" for name in ("errors", "registry", "store", "grid", "session", "config", "studies", "report")
)
"""What a study imports and that decides none of its numbers."""


@registry.remember
def study_hash(study: str) -> str:
    """Hash of the file that says what is measured, and of what it imports."""
    found = registry.sources(f"bench.studies.{study}", BOOKKEEPING)
    report = Path(__file__).parent / "report"
    return registry.hash_of(path for path in found if report not in path.parents)


def reference_backends(cell: Cell) -> Iterator[Backend]:
    """Backends able to run the cell's program for a reference, best first, the cell's own last.

    A backend with physics of its own runs a program of its own, for which it alone can speak.
    """
    if "physics" not in cell.backend.provides:
        yield from ranked_backends(cell)
    yield cell.backend


def ranked_backends(cell: Cell) -> list[Backend]:
    """The available backends that compute references and can run the scene's own program, best first."""
    if cell.program_key not in _ranked:
        _ranked[cell.program_key] = sorted(_able(cell), key=lambda b: b.reference_rank or 0)
    return _ranked[cell.program_key]


def _able(cell: Cell) -> Iterator[Backend]:
    try:
        program = cell.program()
    except Unsupported:
        return
    for entry in registry.entries()["backends"].values():
        plugin = entry.plugin
        if plugin is None or not entry.available or not issubclass(plugin, Backend) or plugin.reference_rank is None:
            continue
        backend = cast(Backend, _build(plugin, ()))
        with suppress(Exception):  # what cannot even be asked is not able
            if program.needs <= backend.provides and backend.refuses(program) is None:
                yield backend


# ------------------------------------------------------------------------------------------------ expansion


def cells(experiment: Experiment) -> list[Cell]:
    """The cells of an experiment, each once, in sweep order; raises :class:`UserError` for what cannot be."""
    _check_axes(experiment)
    found: dict[str, Cell] = {}
    expansion = _Expansion(experiment)
    for point in points(experiment.sweep):
        for choices in itertools.product(*(experiment.choices[kind] for kind in AXES.values())):
            cell = expansion.cell(point, choices)
            found.setdefault(cell.key, cell)
    if not found:
        raise UserError("the experiment has no cells: choose at least one of each of scenes, backends, estimators")
    return list(found.values())


def points(sweep: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The points of a sweep: named axes are multiplied, ``zip`` steps through its axes together, ``union`` joins sweeps.

    ``{a: [1, 2], b: [3], zip: {c: [4, 5], d: [6, 7]}}`` has 4 points; ``{union: [s1, s2]}`` those of s1, then of s2.
    """
    factors: list[list[dict[str, Any]]] = []
    for axis, value in sweep.items():
        if axis == "product":
            factors.append(points(_mapping(value, "sweep.product")))
        elif axis == "zip":
            columns = {name: _values(name, v) for name, v in _flat(_mapping(value, "sweep.zip")).items()}
            lengths = {name: len(v) for name, v in columns.items()}
            if len(set(lengths.values())) > 1:
                raise UserError(f"zipped axes must be equally long, given {lengths}")
            factors.append([dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)])
        elif axis == "union":
            if not isinstance(value, list | tuple):
                raise UserError("sweep.union must be a list of sweeps")
            factors.append([point for part in value for point in points(_mapping(part, "sweep.union"))])
        else:
            factors.extend([{name: v} for v in _values(name, vs)] for name, vs in _flat({axis: value}).items())
    return [_joined(combo) for combo in itertools.product(*factors)]


def _joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    point = dict(itertools.chain(*(part.items() for part in parts)))
    if len(point) < sum(map(len, parts)):
        name = next(name for name in point if sum(name in part for part in parts) > 1)
        raise UserError(f"sweep axis '{name}' is given twice: once by itself and once in a zip, union or product")
    return point


def swept(sweep: Mapping[str, Any]) -> list[str]:
    """Names of the axes of a sweep, in order."""
    return list(dict.fromkeys(name for point in points(sweep) for name in point))


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must be axes with lists of values, not {value!r}")
    return value


def _flat(sweep: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in sweep.items():
        path = f"{prefix}{name}"
        flat.update(_flat(value, path + ".") if isinstance(value, Mapping) else {path: value})
    return flat


def _values(axis: str, values: Any) -> list[Any]:
    listed = list(values) if isinstance(values, list | tuple) else [values]
    if not listed:
        raise UserError(f"sweep.{axis} is empty: give at least one value")
    return listed


def _applies(axis: str, plugin: type[Plugin]) -> str | None:
    """The parameter of ``plugin`` that the axis names, or None: ``gamma``, ``alpha_order.gamma``, ``estimator.alpha_order.gamma``."""
    *path, parameter = axis.split(".")
    if parameter not in registry.parameters(plugin):
        return None
    group = next(g for g, kind in AXES.items() if kind == plugin.kind)
    return parameter if path in ([], [plugin.name], [group, plugin.name]) else None


def _check_axes(experiment: Experiment) -> None:
    chosen = [c.entry.plugin for kind in AXES.values() for c in experiment.choices[kind] if c.entry.plugin]
    names = {name for plugin in chosen for name in registry.parameters(plugin)} | set(COUNTS)
    for axis in swept(experiment.sweep):
        if axis not in COUNTS and not any(_applies(axis, plugin) for plugin in chosen):
            raise unknown("sweep axis", axis, names)


class _Expansion:
    """Makes the cells of an experiment, and their plugins once for all cells that share the values concerning them."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._axes: dict[tuple[type[Plugin], tuple[str, ...]], list[tuple[str, str]]] = {}
        self._made: dict[tuple[int, str], Plugin] = {}

    def cell(self, point: Mapping[str, Any], choices: Sequence[Choice]) -> Cell:
        """The cell of these choices at a point of the sweep."""
        used: dict[str, str] = {}
        scene_choice, contact_choice, integrator_choice, backend_choice, estimator_choice = choices
        scene = cast(Scene, self._plugin(scene_choice, point, used))
        contact: ContactLaw | None = None
        integrator: Integrator | None = None
        if isinstance(scene, MechanicalScene):
            integrator = cast(Integrator, self._plugin(integrator_choice, point, used))
            if scene.n_contacts:
                contact = cast(ContactLaw, self._plugin(contact_choice, point, used, scene.contact_values))
        backend = cast(Backend, self._plugin(backend_choice, point, used))
        estimator = cast(Estimator, self._plugin(estimator_choice, point, used))
        return Cell(
            scene, contact, integrator, backend, estimator, **self._counts(point), study=self._experiment.study,
            timing=bool(self._experiment.timing), budget=self._experiment.budget,
        )  # fmt: skip

    def _counts(self, point: Mapping[str, Any]) -> dict[str, int]:
        counts: dict[str, int] = {}
        for name, low in (("samples", 1), ("repeats", 2), ("seed", 0)):
            count = registry.coerce(int, point.get(name, getattr(self._experiment, name)), name)
            if count < low:
                raise UserError(f"{name}={count} must be at least {low}")
            counts[name] = count
        return counts

    def _plugin(
        self, choice: Choice, point: Mapping[str, Any], used: dict[str, str], given: Mapping[str, Any] | None = None
    ) -> Plugin:
        plugin = choice.entry.plugin
        if plugin is None:
            raise UserError(
                f"{choice.entry.kind.removesuffix('s')} '{choice.entry.name}' cannot be used: {choice.entry.reason}"
            )
        axes = self._axes_of(plugin, tuple(point))
        for axis, parameter in axes:
            if axis in used:
                raise UserError(
                    f"sweep axis '{axis}' is a parameter of both {used[axis]} and {plugin.name}: "
                    f"write sweep.{used[axis]}.{parameter} or sweep.{plugin.name}.{parameter}"
                )
            used[axis] = plugin.name
        key = (id(choice), repr([point[axis] for axis, _ in axes] + [given]))
        if key not in self._made:
            group = next(g for g, kind in AXES.items() if kind == plugin.kind)
            values = {k: v for k, v in (given or {}).items() if k in registry.parameters(plugin)}
            values |= self._experiment.values.get(group, {}).get(plugin.name, {})
            values |= dict(choice.values) | {parameter: point[axis] for axis, parameter in axes}
            self._made[key] = _build(plugin, sorted(values.items()))
        return self._made[key]

    def _axes_of(self, plugin: type[Plugin], names: tuple[str, ...]) -> list[tuple[str, str]]:
        """Axes that are parameters of the plugin, and which."""
        if (plugin, names) not in self._axes:
            found = [(name, _applies(name, plugin)) for name in names if name not in COUNTS]
            self._axes[plugin, names] = [(axis, parameter) for axis, parameter in found if parameter is not None]
        return self._axes[plugin, names]


_built: dict[tuple[type[Plugin], str], Plugin] = {}


def _build(plugin: type[Plugin], values: Sequence[tuple[str, Any]]) -> Plugin:
    """The one instance with these values; 1, 1.0 and True are three values, of which a parameter may refuse some."""
    key = (plugin, repr(values))
    if key not in _built:
        _built[key] = registry.build(plugin, dict(values))
    return _built[key]
