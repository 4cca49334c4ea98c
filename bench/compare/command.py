"""The command ``compare``, and what it shares with the function of the same name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.compare.cells import assumed_defaults, compare_cells
from bench.compare.report import Comparison, show, write
from bench.compare.sources import Results, open_results
from bench.compare.timings import RUNS
from bench.errors import UserError, local_path
from bench.experiment.columns import Column
from bench.experiment.words import parse_flag, parse_words

OUT = Path("runs/compare")
"""The folder of the files, unless ``out=DIR`` names another one."""


@dataclass(frozen=True)
class Request:
    """The two results to compare and the options, from the command line."""

    before: str
    after: str
    out: Path
    timings: bool = False
    again: tuple[str, ...] = ()
    """Further runs of ``before``, which show how much times differ between runs."""


def main(words: Sequence[str]) -> int:
    """Compare the two results named in ``words``. Returns 1 if something got worse. Raises :class:`UserError`."""
    parsed = _parse(words)
    comparison = compare_results(parsed)
    show(comparison, write(comparison, parsed.out))
    return 1 if comparison.worse else 0


def compare_results(request: Request) -> Comparison:
    """Open the requested results and compare them. Raises :class:`UserError`."""
    with ExitStack() as stack:
        names = (request.before, request.after, *request.again)
        old, new, *again = (stack.enter_context(open_results(name)) for name in names)
        return compare_opened(request, old, new, again)


def compare_opened(
    request: Request,
    old: Mapping[str, Results],
    new: Mapping[str, Results],
    again: Sequence[Mapping[str, Results]] = (),
) -> Comparison:
    """Compare the accuracy of the experiments that two results have in common, and their times if requested."""
    before, after = request.before, request.after
    shared = [name for name in old if name in new]
    if not shared:
        raise UserError(f"{before} ({', '.join(old)}) and {after} ({', '.join(new)}) have no experiment in common")
    remarks = [
        f"{name} is only in {side}: not compared"
        for side, mine, other in ((before, old, new), (after, new, old))
        for name in mine
        if name not in other
    ]
    parts = []
    judged: dict[str, Column] = {}
    for name in shared:
        one, two = old[name], new[name]
        if one.study != two.study:
            raise UserError(f"{name} is of study {one.study} in {before} and of study {two.study} in {after}")
        runs = [results[name].rows for results in again if name in results]
        judged |= {column.name: column for column in one.columns.compared}
        table, time_remarks = compare_cells(one.rows, two.rows, one.columns, request.timings, runs)
        own = (
            *row_remarks(one, two),
            *version_remarks(one.rows, two.rows),
            *machine_remarks(one, two, request.timings),
            *time_remarks,
        )
        remarks += [f"{name}: {remark}" for remark in own]
        parts.append(table.assign(experiment=name))
    table = pd.concat(parts, ignore_index=True)
    return Comparison(f"{before} against {after}", table, remarks, list(judged.values()), old[shared[0]].study)


def row_remarks(old: Results, new: Results) -> list[str]:
    """Return remarks on omitted rows, and on parameters that one side lacks, so that their present default is assumed."""
    remarks = [
        f"{results.n_outdated} rows {when} were made by an older version and are left out"
        for when, results in (("before", old), ("after", new))
        if results.n_outdated
    ]
    missing = {"before": assumed_defaults(old.rows), "after": assumed_defaults(new.rows)}
    for when, other in (("before", "after"), ("after", "before")):
        own = [f"{name}={value}" for name, value in missing[when].items() if name not in missing[other]]
        if own:
            remarks.append(f"rows {when} do not store {', '.join(own)}: the present default is assumed")
    return remarks


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
    versions: dict[str, list[str]] = {}
    for texts in rows.get("versions", pd.Series(dtype=str)).dropna().unique():
        for library, separator, version in (part.partition("=") for part in str(texts).split(";")):
            if separator and version not in versions.setdefault(library, []):
                versions[library].append(version)
    return {library: sorted(numbers) for library, numbers in versions.items()}


def machine_remarks(old: Results, new: Results, timings: bool) -> list[str]:
    """Return remarks on different machines and, if times are compared, on reasons to doubt them."""
    remarks: list[str] = []
    machines = f"{old.machine or 'unknown'}; {new.machine or 'unknown'}"
    is_same = bool(old.machine) and old.machine == new.machine
    if timings and not is_same:
        remarks.append(f"WARNING: timings of different machines ({machines}) are compared")
    elif not is_same:
        remarks.append(f"made on different machines ({machines}): rounding may change the estimates of chaotic cells")
    if timings:
        for when, results in (("before", old), ("after", new)):
            if results.busy:
                remarks.append(f"WARNING: the machine was busy {when} ({results.busy}), so timings are doubtful")
    return remarks


def _parse(words: Sequence[str]) -> Request:
    defaults = {"timings": "false", "again": "", "out": str(OUT)}
    names, settings, options = parse_words(words, "compare", defaults, ("--timings",))
    if len(names) != 2:
        raise UserError(
            "name two results: python -m bench compare BEFORE AFTER (directories, or revisions as REV or REV:PATH)"
        )
    timings = bool(options) or parse_flag(settings, "timings")
    again = tuple(filter(None, settings["again"].split(",")))
    return request(names[0], names[1], local_path("out", settings["out"]), timings, again)


def request(before: str, after: str, out: Path = OUT, timings: bool = False, again: tuple[str, ...] = ()) -> Request:
    """Return a valid request. Raises :class:`UserError` for further runs without timings, or too few of them."""
    if again and not timings:
        raise UserError("again= names further runs for their times: add --timings")
    if again and len(again) + 1 < RUNS:
        raise UserError(
            f"the spread between runs needs {RUNS} or more runs of before: again= names {len(again)} besides the first"
        )
    return Request(before, after, out, timings, again)
