"""Standard results as the documents need them: answers, tables, files, and errors compared between estimators."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import pandas as pd

import bench
from bench.errors import UserError
from bench.experiment import config
from bench.experiment.experiment import Experiment
from bench.model import registry
from bench.report import answer
from bench.report.writer import ANSWER

ROOT = Path(__file__).resolve().parent.parent
STANDARD = ROOT / "results" / "standard"
PAPER = ROOT / "examples" / "cost_of_error"
"""A study outside the package, with experiments whose results are stored too."""


@dataclass(frozen=True)
class Entry:
    """One experiment: its question, and its answer and files where it has been run."""

    name: str
    question: str
    folder: Path
    answer: str = ""
    chart: Path | None = None

    @property
    def page(self) -> str:
        """The name of the experiment's page on the site, that of its folder."""
        return f"experiment/{self.folder.name}"

    @property
    def command(self) -> str:
        """The command that runs the experiment."""
        is_own = not (PAPER / "experiment" / f"{self.name}.yaml").exists()
        return f"python -m bench +experiment={self.name}" + ("" if is_own else f" plugins={PAPER.relative_to(ROOT)}")

    @property
    def has_results(self) -> bool:
        """Whether the experiment has been run."""
        return (self.folder / ANSWER).exists()

    @property
    def charts(self) -> list[Path]:
        """The experiment's charts."""
        return sorted(self.folder.glob("*.png"))

    @property
    def tables(self) -> list[Path]:
        """The experiment's tables in Markdown, those that summarise first."""
        return sorted(self.folder.glob("*.md"), key=lambda path: path.stat().st_size)

    @property
    def made(self) -> str:
        """When and with which cells and library versions the stored rows were made, as one sentence."""
        path = self.folder / "run.json"
        record = json.loads(path.read_text()) if path.exists() else {}
        counts = ", ".join(f"{count} {status}" for status, count in sorted(record.get("counts", {}).items()))
        return f"Stored cells by status: {counts}." if counts else ""

    def data(self) -> Iterator[tuple[Path, str]]:
        """Yield each data file and its content in words."""
        words = {".csv": "table, every digit", ".parquet": "all rows with all columns", ".md": "readable table"}
        words |= {".tex": "table for a paper", ".json": "settings, versions, machine and counts"}
        for path in sorted(self.folder.iterdir()):
            if path.suffix in words and not path.name.endswith(".plotted.csv") and path.name != ANSWER:
                yield path, words[path.suffix]


def entries_of(results: Path) -> list[Entry]:
    """Return every experiment with its answer, in alphabetical order; those not run yet have none."""
    return [entry_of(name, own.question, own.directory) for name, own in loaded(results).items()]


@cache
def loaded(results: Path) -> dict[str, Experiment]:
    """Return every experiment by name."""
    registry.add_folder(PAPER)
    # an experiment with other settings than its file's would be loaded twice, to compare them
    found = {name: config.load([f"experiment={name}"]) for name in config.experiments([PAPER])}
    return {name: replace(experiment, results_dir=results) for name, experiment in found.items()}


def entry_of(name: str, question: str, folder: Path) -> Entry:
    """Return an experiment with the content of its ``answer.json``."""
    path = folder / ANSWER
    if not path.exists():
        return Entry(name, question, folder)
    record = json.loads(path.read_text())
    picture = folder / f"{Path(record['chart']).name}.png"
    return Entry(name, question, folder, record["answer"], picture if picture.exists() else None)


@cache
def table_of(name: str, results: Path = STANDARD) -> pd.DataFrame:
    """Return a stored table, ``train/windows``: the folder of an experiment and the name of its CSV, or the rows of ``train``."""
    if "/" not in name:
        return rows_of(name, results)
    path = results / f"{name}.csv"
    if not path.exists():
        raise UserError(f"'{path}' does not exist")
    return pd.read_csv(path)


def answer_of(experiment: str, results: Path = STANDARD) -> str:
    """Return an experiment's answer with its numbers; raises LookupError if the stored tables do not carry it."""
    own = loaded(results)[experiment]
    return answer.fill(own.answer, lambda name: table_of(f"{own.name}/{name}", results))


@cache
def rows_of(experiment: str, results: Path = STANDARD) -> pd.DataFrame:
    """Return an experiment's stored rows, one per cell, with a column per swept axis."""
    return bench.load(results / experiment)


@cache
def comparison(results: Path = STANDARD) -> pd.DataFrame:
    """Return the relative RMSE of each setting of an estimator on each problem, with its 95% interval and verdict.

    They are those of the experiment ``estimators``. ``best``: lowest, or not distinguishable from the lowest. ``biased``: more
    than half of the squared error is bias.
    """
    methods, settings = (table_of(f"estimators/{name}", results) for name in ("verdicts", "comparisons"))
    names = (settings["first"].fillna("") + ", " + settings["tied"].fillna("")).str.split(", ")
    best = set(settings.assign(name=names).explode("name")[["problem", "name"]].itertuples(index=False, name=None))
    parts = methods["estimator"].str.partition("[")
    return methods.rename(columns={"error": "rmse_rel", "error_low": "low", "error_high": "high"}).assign(
        estimator=parts[0],
        estimator_params=parts[2].str.removesuffix("]"),
        best=[pair in best for pair in zip(methods["problem"], methods["method"], strict=True)],
        biased=methods["bias_share"] > 0.5,
    )
