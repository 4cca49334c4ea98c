"""What a CI server needs of examinations: a baseline to compare with, a Markdown summary, and JUnit XML."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from bench.errors import StorageError, UserError
from bench.examine.findings import Findings
from bench.examine.text import advice, conclusion, problems, table
from bench.report.text import counted, duration, number

GREW = 2.0
"""Ratio of the sizes of an error, or of numbers of calls, above which a change is reported."""
RESULTS = {0: "right", 1: "wrong", 2: "bad input", 3: "not decided"}
"""The result by exit status."""
COLUMNS = ("cost", "result", "cause", "off by", "under noise", "costs", "gradients", "seconds")
"""Columns of the summary."""


def summary(report: Findings) -> dict[str, Any]:
    """Return what a baseline stores of a report: its verdicts, the size of its error, and its calls."""
    size = report.size
    return {
        "name": report.name,
        "status": report.status,
        "derivative": report.derivative,
        "cause": report.cause,
        "size": size if math.isfinite(size) else None,
        "costs": report.spent.costs,
        "gradients": report.spent.gradients,
    }


def read_baseline(path: Path) -> dict[str, Any] | None:
    """Return a stored baseline, or None if the file does not exist. Raises :class:`UserError` for another file."""
    try:
        stored = json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"baseline={path} cannot be read: {error}. Delete it to write a new one") from None
    expected = {"status": int, "derivative": str, "cause": str, "costs": int}
    if not isinstance(stored, Mapping) or not all(isinstance(stored.get(key), kind) for key, kind in expected.items()):
        raise UserError(f"baseline={path} is not a baseline of examine: it needs {', '.join(expected)}")
    return dict(stored)


def write_baseline(path: Path, report: Findings) -> None:
    """Write the baseline of a report. Raises :class:`StorageError` if that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(summary(report), indent=1) + "\n")
    except OSError as error:
        raise StorageError(f"baseline={path} cannot be written: {error}") from None


def differences(before: Mapping[str, Any], report: Findings) -> tuple[list[str], bool]:
    """Return what changed since a baseline, as sentences, and whether something is worse.

    Worse is a problem that was not there before, or the same one with an error more than twice as large.
    """
    now = summary(report)
    changes = [
        f"{key} was {before[key]}, is {now[key]}" for key in ("derivative", "cause") if before.get(key) != now[key]
    ]
    is_worse = bool(now["status"] and (before["status"] == 0 or before["cause"] != now["cause"]))
    old, new = before.get("size"), now["size"]
    if isinstance(old, int | float) and new is not None and max(old, new) > 1e-6:
        if new > GREW * old or old > GREW * new:
            changes.append(f"the error was {number(100 * old)}%, is {number(100 * new)}%")
        is_worse |= bool(now["status"] and new > GREW * old)
    for key in ("costs", "gradients"):
        old, new = before.get(key), now[key]
        if isinstance(old, int) and max(old, new) > GREW * max(min(old, new), 1):
            changes.append(f"{key} were {old:,}, are {new:,}")
    return changes, is_worse


def row(report: Findings) -> dict[str, str]:
    """Return a report as a row of the summary."""
    spent, result = report.spent, RESULTS[report.status]
    if report.status == 0 and (report.derivative == "none given" or problems(report)):
        result = "no gradient" if not problems(report) else "as expected" if report.expect else "as before"
    return {
        "cost": report.name, "result": result, "cause": report.cause,
        "off by": number(100 * report.size) + "%" if report.gradient and math.isfinite(report.size) else "-",
        "under noise": report.use if report.gradient else "-", "costs": str(spent.costs), "gradients": str(spent.gradients),
        "seconds": duration(spent.seconds + spent.compile_s),
    }  # fmt: skip


def _rows(reports: Sequence[Findings], refused: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the rows of the summary, those of bad input last."""
    bad = [dict.fromkeys(COLUMNS, "-") | {"cost": name, "result": RESULTS[2]} for name in refused]
    return [*map(row, reports), *bad]


def as_markdown(reports: Sequence[Findings], refused: Mapping[str, str] | None = None) -> str:
    """Return a summary in Markdown: a table with a row per report, then the problems and changes of each."""
    refused = refused or {}
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(map(_cell, cells.values())) + " |" for cells in _rows(reports, refused)]
    for report in reports:
        texts = [*problems(report), *(f"since the baseline: {text}" for text in report.changes)]
        if texts or advice(report):
            lines += ["", f"**{_cell(report.name)}**", ""]
            lines += [f"- {_cell(text)}" for text in texts]
            lines += [f"- next: {_cell(advice(report))}"] if advice(report) and report.status else []
    lines += [f"\n**{_cell(name)}**\n\n- bad input: {_cell(text)}" for name, text in refused.items()]
    return "\n".join(lines) + "\n"


def as_text(reports: Sequence[Findings], refused: Mapping[str, str] | None = None) -> str:
    """Return the summary's table with aligned columns."""
    refused = refused or {}
    return "\n".join([*table("", _rows(reports, refused))[1:], *(f"{name}: {text}" for name, text in refused.items())])


def as_junit(reports: Sequence[Findings], refused: Mapping[str, str] | None = None) -> str:
    """Return JUnit XML with a test case per report: wrong is a failure, not decided and bad input are errors."""
    refused = refused or {}
    failures = sum(report.status == 1 for report in reports)
    errors = sum(report.status == 3 for report in reports) + len(refused)
    counts = {"tests": str(len(reports) + len(refused)), "failures": str(failures), "errors": str(errors)}
    root = ElementTree.Element("testsuites", {"name": "examine", **counts})
    suite = ElementTree.SubElement(root, "testsuite", {"name": "examine", **counts})
    for report in reports:
        case = ElementTree.SubElement(
            suite, "testcase", classname="examine", name=_xml_safe(report.name),
            time=f"{report.spent.seconds + report.spent.compile_s:.3f}",
        )  # fmt: skip
        if report.status:
            kind = "failure" if report.status == 1 else "error"
            message = _xml_safe(problems(report)[0] if problems(report) else conclusion(report))
            ElementTree.SubElement(case, kind, type=report.cause, message=message).text = _xml_safe(str(report))
        else:
            ElementTree.SubElement(case, "system-out").text = _xml_safe(str(report))
    for name, text in refused.items():
        case = ElementTree.SubElement(suite, "testcase", classname="examine", name=_xml_safe(name), time="0")
        ElementTree.SubElement(case, "error", type="bad input", message=_xml_safe(text))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def as_line(reports: Sequence[Findings], refused: Mapping[str, str] | None = None) -> str:
    """Return the counts of results in one line."""
    results = [RESULTS[report.status] for report in reports] + [RESULTS[2]] * len(refused or {})
    kinds = [f"{results.count(kind)} {kind}" for kind in RESULTS.values() if kind in results]
    return f"{counted(len(results), 'cost')}: {', '.join(kinds)}"


def status(reports: Sequence[Findings], refused: Mapping[str, str] | None = None) -> int:
    """Return the exit status of several reports: 1 if one is wrong, else 2 for bad input, else 3 if one is not decided."""
    statuses = {report.status for report in reports} | ({2} if refused else set())
    return next((one for one in (1, 2, 3) if one in statuses), 0)


def _cell(text: str) -> str:
    """Return text for a Markdown table, without characters that would end a cell or start markup."""
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def _xml_safe(text: str) -> str:
    """Return text without characters that XML cannot contain."""
    return "".join(c if c in "\t\n" or 0x20 <= ord(c) <= 0xD7FF or 0xE000 <= ord(c) <= 0xFFFD else "?" for c in text)
