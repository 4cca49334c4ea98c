"""Compares two sets of results cell by cell: did something get worse?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from bench.compare.cells import compared
from bench.compare.report import Comparison, show, write
from bench.compare.sources import Results, opened
from bench.errors import UserError, unknown
from bench.model import registry
from bench.sweep.columns import Column

SETTINGS = ("timings", "out", "plugins")


def main(words: Sequence[str]) -> int:
    """Compare the two results named in ``words``; returns 1 if something got worse. Raises :class:`UserError`."""
    before, after, timings, out = _parsed(words)
    with opened(before) as old, opened(after) as new:
        comparison = compare(before, old, after, new, timings)
    show(comparison, write(comparison, out))
    return 1 if comparison.worse else 0


def compare(
    before: str, old: Mapping[str, Results], after: str, new: Mapping[str, Results], timings: bool
) -> Comparison:
    """Compare the experiments that two results have in common; times of different machines only with ``timings``."""
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
        same = bool(one.machine) and one.machine == two.machine
        remarks += [f"{name}: {remark}" for remark in _older(one, two) + timing_remarks(one, two, same, timings)]
        judged |= {column.name: column for column in one.columns.judged}
        parts.append(compared(one.rows, two.rows, one.columns, timings or same).assign(experiment=name))
    table = pd.concat(parts, ignore_index=True)
    return Comparison(f"{before} against {after}", table, remarks, list(judged.values()), old[shared[0]].study)


def _older(old: Results, new: Results) -> list[str]:
    return [
        f"{results.older} rows {when} were made by an older version and are left out"
        for when, results in (("before", old), ("after", new))
        if results.older
    ]


def timing_remarks(old: Results, new: Results, same: bool, timings: bool) -> list[str]:
    """Return why times are not compared or are doubtful; nothing where the study judges no times."""
    remarks: list[str] = []
    if not any(column.judged and column.judged.by == "time" for column in old.columns.judged):
        return remarks
    if not same:
        which = f"timings of different machines ({old.machine or 'unknown'}; {new.machine or 'unknown'})"
        remarks.append(
            f"WARNING: {which} are compared" if timings else f"{which} are not compared: add --timings to do so"
        )
    if same or timings:
        for when, results in (("before", old), ("after", new)):
            if results.busy:
                remarks.append(f"WARNING: the machine was busy {when} ({results.busy}), so timings are doubtful")
    return remarks


def _parsed(words: Sequence[str]) -> tuple[str, str, bool, Path]:
    names, settings = [], {"timings": "false", "out": "runs/compare"}
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
    return names[0], names[1], settings["timings"] == "true", Path(settings["out"]).expanduser()
