"""Compares two sets of results cell by cell: did something get worse?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.compare.cells import compared
from bench.compare.report import Comparison, show, write
from bench.compare.sources import Results, opened
from bench.compare.timings import RUNS
from bench.errors import UserError, unknown
from bench.experiment.columns import Column
from bench.model import registry

SETTINGS = ("timings", "again", "out", "plugins")


@dataclass(frozen=True)
class Asked:
    """What a command line asks for."""

    before: str
    after: str
    out: Path
    timings: bool = False
    again: tuple[str, ...] = ()
    """Further runs of before, which show how much times differ between runs."""


def main(words: Sequence[str]) -> int:
    """Compare the two results named in ``words``; returns 1 if something got worse. Raises :class:`UserError`."""
    asked = _parsed(words)
    with ExitStack() as stack:
        old, new, *again = (stack.enter_context(opened(name)) for name in (asked.before, asked.after, *asked.again))
        comparison = compare(asked, old, new, again)
    show(comparison, write(comparison, asked.out))
    return 1 if comparison.worse else 0


def compare(
    asked: Asked,
    old: Mapping[str, Results],
    new: Mapping[str, Results],
    again: Sequence[Mapping[str, Results]] = (),
) -> Comparison:
    """Compare the experiments that two results have in common: accuracy, and times only where they are asked for."""
    before, after = asked.before, asked.after
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
        table, said = compared(one.rows, two.rows, one.columns, asked.timings, runs)
        remarks += [
            f"{name}: {remark}" for remark in (*_older(one, two), *machine_remarks(one, two, asked.timings), *said)
        ]
        parts.append(table.assign(experiment=name))
    table = pd.concat(parts, ignore_index=True)
    return Comparison(f"{before} against {after}", table, remarks, list(judged.values()), old[shared[0]].study)


def _older(old: Results, new: Results) -> list[str]:
    return [
        f"{results.older} rows {when} were made by an older version and are left out"
        for when, results in (("before", old), ("after", new))
        if results.older
    ]


def machine_remarks(old: Results, new: Results, timings: bool) -> list[str]:
    """Return what other machines mean for the comparison, and, where times are judged, why those are doubtful."""
    remarks: list[str] = []
    which = f"{old.machine or 'unknown'}; {new.machine or 'unknown'}"
    other = not old.machine or old.machine != new.machine
    if timings and other:
        remarks.append(f"WARNING: timings of different machines ({which}) are compared")
    elif other:
        remarks.append(f"made on different machines ({which}): rounding may move the estimates of chaotic cells")
    if timings:
        for when, results in (("before", old), ("after", new)):
            if results.busy:
                remarks.append(f"WARNING: the machine was busy {when} ({results.busy}), so timings are doubtful")
    return remarks


def _parsed(words: Sequence[str]) -> Asked:
    names, settings = [], {"timings": "false", "out": "runs/compare", "again": ""}
    for word in words:
        key, equals, value = word.partition("=")
        if word == "--timings":
            settings["timings"] = "true"
        elif equals and not key.startswith("-") and "/" not in key:
            if key not in SETTINGS:
                raise unknown("setting of compare", key, SETTINGS)
            if key == "plugins":
                registry.add_folder(Path(value))
            settings[key] = value
        else:
            names.append(word)
    if len(names) != 2:
        raise UserError(
            "name two results: python -m bench compare BEFORE AFTER (directories, or revisions as REV or REV:PATH)"
        )
    if settings["timings"] not in ("true", "false"):
        raise unknown("value for timings:", settings["timings"], ("true", "false"))
    again = tuple(filter(None, settings["again"].split(",")))
    if again and settings["timings"] == "false":
        raise UserError("again= names further runs for their times: add --timings")
    if again and len(again) + 1 < RUNS:
        raise UserError(
            f"a spread between runs takes {RUNS} runs of before or more: again= names {len(again)} besides it"
        )
    return Asked(names[0], names[1], Path(settings["out"]).expanduser(), settings["timings"] == "true", again)
