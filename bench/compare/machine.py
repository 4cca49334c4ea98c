"""Writes a comparison for other programs: JSON, and JUnit XML as CI servers show it."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from xml.etree import ElementTree

import pandas as pd

from bench.compare.cells import OUTCOMES

CONTROL = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, from messages of other people's code."""


def counts(table: pd.DataFrame) -> dict[str, int]:
    """Return the number of cells by outcome, the worst first."""
    found = table["outcome"].value_counts()
    return {outcome: int(found.get(outcome, 0)) for outcome in OUTCOMES}


def as_json(title: str, table: pd.DataFrame, names: Sequence[str], remarks: Sequence[str]) -> str:
    """Write the verdict, the counts, the remarks and every cell that is not the same; ``names`` are those of its cells."""
    result = {
        "comparison": title,
        "worse": bool((table["outcome"] == "worse").any()),
        "counts": counts(table),
        "experiments": {str(name): counts(part) for name, part in table.groupby("experiment", sort=False)},
        "remarks": list(remarks),
        "cells": [
            {
                "outcome": row["outcome"], "experiment": row["experiment"], "cell": name, "change": row["change"],
                "status_before": row["status_before"], "status_after": row["status_after"],
                "parameters": json.loads(row["parameters"]),
            }
            for row, name in zip(table.to_dict("records"), names, strict=True)
            if row["outcome"] != "same"
        ],
    }  # fmt: skip
    return json.dumps(result, indent=1) + "\n"


def as_junit(title: str, table: pd.DataFrame, names: Sequence[str]) -> str:
    """Write a test suite per experiment and a test case per cell, a failure where it got worse."""
    root = ElementTree.Element(
        "testsuites", name=_plain(title), tests=str(len(table)), failures=str(counts(table)["worse"])
    )
    named = table.assign(_name=list(names))
    for experiment, part in named.groupby("experiment", sort=False):
        suite = ElementTree.SubElement(
            root, "testsuite", name=_plain(str(experiment)), tests=str(len(part)), failures=str(counts(part)["worse"])
        )
        for row in part.to_dict("records"):
            case = ElementTree.SubElement(
                suite, "testcase", classname=_plain(str(experiment)), name=_plain(row["_name"])
            )
            if row["outcome"] == "worse":
                ElementTree.SubElement(case, "failure", message=_plain(row["change"]))
            elif row["outcome"] != "same":
                ElementTree.SubElement(case, "system-out").text = _plain(f"{row['outcome']}: {row['change']}")
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _plain(text: str) -> str:
    return CONTROL.sub("?", text)
