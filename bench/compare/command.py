"""The command ``compare``, and the function of the same name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from bench.compare.cells import compare_cells
from bench.compare.report import Comparison, write
from bench.compare.sources import Results, read_results
from bench.compare.timings import RUNS
from bench.errors import UserError, local_path
from bench.experiment.columns import Column
from bench.experiment.words import parse_words


def main(words: Sequence[str]) -> int:
    """Compare the two results named in ``words``. Returns 1 if something got worse. Raises :class:`UserError`."""
    names, settings, _ = parse_words(words, "compare", {"again": "", "out": "runs/compare"})
    if len(names) != 2:
        raise UserError(
            "name two results: python -m bench compare BEFORE AFTER (directories, or revisions as REV or REV:PATH)"
        )
    out = local_path("out", settings["out"])
    comparison = compare(names[0], names[1], [*filter(None, settings["again"].split(","))])
    print(comparison, "\nWritten:", *write(comparison, out), sep="\n  ")
    return int(comparison.worse)


def compare(before: str | Path, after: str | Path, again: Sequence[str | Path] = ()) -> Comparison:
    """Compare two results, cell by cell; ``print`` shows what got worse or better.

    ``before`` and ``after`` are directories of experiments or of one experiment, or git revisions as ``REV`` or
    ``REV:PATH``. ``comparison.to_frame()`` has one row per cell, and ``comparison.worse`` is true if some cell got
    worse. With ``again``, two or more further runs of ``before``, times are compared with the spread between runs. Raises
    :class:`bench.UserError` for results that cannot be read or compared.
    """
    if again and len(again) + 1 < RUNS:
        raise UserError(
            f"the spread between runs needs {RUNS} or more runs of before: again= names {len(again)} besides the first"
        )
    old, new, *more = (read_results(str(name)) for name in (before, after, *again))
    shared = [name for name in old if name in new]
    if not shared:
        raise UserError(f"{before} ({', '.join(old)}) and {after} ({', '.join(new)}) have no experiment in common")
    remarks = [f"{name} is only in {after}: not compared" for name in new if name not in old]
    parts = []
    judged: dict[str, Column] = {}
    for name, one in old.items():
        two = new.get(name, replace(one, rows=one.rows.iloc[:0]))
        if name not in new:
            remarks.append(f"{name} is only in {before}: its cells are gone")
        elif one.study != two.study:
            raise UserError(f"{name} is of study {one.study} in {before} and of study {two.study} in {after}")
        elif not one.is_installed and one.content != two.content:
            raise UserError(
                f"{name} cannot be judged: its study '{one.study}' is not installed, and its files differ; plugins=DIR adds yours"
            )
        runs = [results[name].rows for results in more if name in results]
        judged |= {column.name: column for column in one.columns.compared}
        table, of_times = compare_cells(one.rows, two.rows, one.columns, runs)
        own = [
            *version_remarks(one.rows, two.rows),
            *machine_remarks(one, two, bool(again)),
        ]
        remarks += [f"{name}: {remark}" for remark in (*own, *of_times)]
        parts.append(table.assign(experiment=name))
    return Comparison(f"{before} against {after}", pd.concat(parts, ignore_index=True), remarks, list(judged.values()))


def version_remarks(old: pd.DataFrame, new: pd.DataFrame) -> list[str]:
    """Return a remark with the libraries whose versions differ, as ``newton 1.0.0 to 1.8.0``."""
    was, now = (_library_versions(rows) for rows in (old, new))
    moved = [
        f"{library} {' and '.join(was[library])} to {' and '.join(now[library])}"
        for library in was
        if library in now and was[library] != now[library]
    ]
    return [f"other versions: {', '.join(moved)}"] if moved else []


def _library_versions(rows: pd.DataFrame) -> dict[str, list[str]]:
    """Return the versions of each library that a column ``versions`` has, as ``engine:library`` in an engine's Python."""
    texts = rows.get("versions", pd.Series(dtype=str)).dropna().unique()
    pairs = sorted({tuple(part.split("=", 1)) for text in texts for part in str(text).split(";") if "=" in part})
    return {library: [number for name, number in pairs if name == library] for library, _ in pairs}


def machine_remarks(old: Results, new: Results, timings: bool) -> list[str]:
    """Return a remark on different machines."""
    if old.machine and old.machine == new.machine:
        return []
    effect = "timings are not comparable" if timings else "rounding may change the estimates of chaotic cells"
    return [f"made on different machines ({old.machine or 'unknown'}; {new.machine or 'unknown'}): {effect}"]
