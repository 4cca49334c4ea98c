"""An experiment: a named sweep, as read from its configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from bench.experiment.columns import Columns
from bench.host.identity import described, identity
from bench.host.parameters import Plugin, param
from bench.host.registry import Entry
from bench.model import Decision, registry
from bench.model.program import OWN


@dataclass(frozen=True)
class Choice:
    """A plugin chosen on an axis, with the parameters of its identity string."""

    entry: Entry
    values: tuple[tuple[str, Any], ...] = ()

    def __str__(self) -> str:
        return identity(self.entry.name, dict(self.values))


@dataclass(frozen=True)
class Execution:
    """How cells are run. It affects none of their numbers."""

    workers: int | None = None
    """Number of processes; None for the number of cores, 0 for this process only."""
    timeout: float | None = None
    """Seconds that a cell may take."""
    memory: int | None = None
    """Bytes of memory that a worker may use."""
    stop: bool = False
    """Whether the first failed cell ends the run."""
    ladder: bool = False
    """Whether the cells of a scene start only when the checks of the scene before it pass."""
    versions: str = "warn"
    """How to treat stored rows computed with other library versions: ``ignore``, ``warn`` or ``rerun``."""
    retry: tuple[str, ...] = ()
    """Statuses of stored rows that are run again."""
    shard: tuple[int, int] | None = None
    """Number, from 1, and count of the parts of which this run is one; None for all cells."""


@dataclass(frozen=True)
class Budget(Plugin):
    """The budget of a reference gradient, the settings ``reference.*``."""

    kind: ClassVar[str] = "settings"
    name: ClassVar[str] = "reference"

    samples: int = param(1 << 18, "largest number of samples", low=256)
    points: int = param(
        1 << 20, "largest number of points of quadrature, and at most 64 times `samples`", low=256, added=True
    )
    tolerance: float = param(0.005, "standard error, relative to the gradient, at which sampling stops", positive=True)


@dataclass(frozen=True)
class Experiment:
    """A named sweep: plugins, parameters, sample counts, and the study that measures each cell."""

    name: str
    study: Any
    """The :class:`bench.experiment.study.Study` that measures it; its module imports this one."""
    choices: Mapping[str, Sequence[Choice]]
    """The chosen plugins by axis (``scene``, ...), in the order of the study's axes."""
    values: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    """Parameters set for plugins by axis, plugin name and parameter."""
    sweep: Mapping[str, Any] = field(default_factory=dict)
    also: tuple[Experiment, ...] = ()
    """Experiments of the same study whose cells join its own."""
    decision: Decision = OWN
    """The meaning of theta, and the point at which gradients are taken."""
    descent: float = 0.0
    """The share of a descent from there that is done."""
    path: Mapping[str, Choice] = field(default_factory=dict)
    """What is descended, by axis: contact law, integrator, and the backend if one is given."""
    samples: int = 256
    repeats: int = 64
    seed: int = 0
    results_dir: Path = Path("results")
    question: str = ""
    answer: str = ""
    """What a person concludes, with references to tables (:mod:`bench.report.answer`); empty if its settings were changed."""
    marks: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Named values by axis, drawn as lines in the charts."""
    compares: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    """What charts show side by side: names of backends or estimators, or values of an axis, of which two are joined by arrows."""
    formats: tuple[str, ...] = ("png",)
    """File formats of the charts."""
    chart_columns: int = 2
    """Columns of a paper that charts in files may be wide, 1 or 2."""
    reference: Budget = Budget()
    compile_cache: Path | None = None
    """Folder in which compiled programs are cached between runs."""
    plugins: tuple[Path, ...] = ()
    """Folders with the user's own plugins."""
    timing: bool = False
    """Whether cells are timed, and therefore run one at a time on a machine."""
    execution: Execution = Execution()

    @property
    def columns(self) -> Columns:
        """The columns of its rows, as the study declares them."""
        return self.study.columns

    @property
    def directory(self) -> Path:
        """Folder of the experiment's files."""
        return self.results_dir / self.name

    @property
    def whole_sweep(self) -> Mapping[str, Any]:
        """The sweep together with those of the parts that ``also`` names."""
        return {"union": [one.sweep for one in (self, *self.also)]} if self.also else self.sweep

    def record(self) -> dict[str, Any]:
        """Return the whole experiment for ``run.json``: values of JSON, and others whose strings stand for them."""
        counts = ("descent", "samples", "repeats", "seed", "timing", "marks", "compares", "formats", "chart_columns")
        return {
            "name": self.name,
            "study": described(self.study),
            "question": self.question,
            **{registry.kind_of(axis): some for axis, some in self.choices.items()},
            "parameters": self.values,
            "sweep": self.sweep,
            "also": [other.record() for other in self.also],
            "theta": self.decision.names,
            "theta0": self.decision.at,
            "path": [*self.path.values()],
            **{name: getattr(self, name) for name in counts},
            "reference": vars(self.reference),
            **{name: getattr(self, name) for name in ("results_dir", "compile_cache", "plugins")},
            "execution": {k: v for k, v in vars(self.execution).items() if k != "shard"},
        }
