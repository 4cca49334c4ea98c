"""Exports a comparison to other programs, as JSON and as JUnit XML for CI servers."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from xml.etree import ElementTree

import pandas as pd

from bench.compare.cells import OUTCOMES

CONTROL = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 does not allow. Error messages of plugins may contain them."""


def count_outcomes(table: pd.DataFrame) -> dict[str, int]:
    """Return the number of cells by outcome, the worst first."""
    outcomes = table["outcome"].value_counts()
    return {outcome: int(outcomes.get(outcome, 0)) for outcome in OUTCOMES}


def as_json(title: str, table: pd.DataFrame, names: Sequence[str], remarks: Sequence[str]) -> str:
    """Return the verdict, counts, remarks and changed cells as JSON. ``names`` are the cells' names, in table order."""
    result = {
        "comparison": title,
        "worse": bool((table["outcome"] == "worse").any()),
        "counts": count_outcomes(table),
        "experiments": {str(name): count_outcomes(part) for name, part in table.groupby("experiment", sort=False)},
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
    """Return JUnit XML with a suite per experiment and a test case per cell, which fails if the cell got worse."""
    root = ElementTree.Element(
        "testsuites", name=_xml_safe(title), tests=str(len(table)), failures=str(count_outcomes(table)["worse"])
    )
    for experiment, part in table.assign(_name=list(names)).groupby("experiment", sort=False):
        suite = ElementTree.SubElement(
            root,
            "testsuite",
            name=_xml_safe(str(experiment)),
            tests=str(len(part)),
            failures=str(count_outcomes(part)["worse"]),
        )
        for row in part.to_dict("records"):
            case = ElementTree.SubElement(
                suite, "testcase", classname=_xml_safe(str(experiment)), name=_xml_safe(row["_name"])
            )
            if row["outcome"] == "worse":
                ElementTree.SubElement(case, "failure", message=_xml_safe(row["change"]))
            elif row["outcome"] != "same":
                ElementTree.SubElement(case, "system-out").text = _xml_safe(f"{row['outcome']}: {row['change']}")
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _xml_safe(text: str) -> str:
    return CONTROL.sub("?", text)
