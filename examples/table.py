"""The table of the examples: runs each example in a process of its own, and stores what its reports say.

    python examples/table.py [--only NAME ...]

Each finished example replaces its rows in `examples/table.json` and in the table of `docs/examine.md`; with ``--only``, the
rows of other examples stay. An example whose libraries are missing is skipped and named. The reports' texts are written to
standard error.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import re
import runpy
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ORDER = (
    "newton_ball", "newton_cartpole", "brax_ball", "drake_ball", "genesis_ball", "taichi_ball", "warp_kernel",
    "gymnasium_cartpole", "jax_rollout", "torch_module", "numpy_loop", "mpc",
)  # fmt: skip
LIMIT = 1800
"""Seconds for one example; the examples have budgets of their own."""
PACKAGES = {
    "brax": "brax", "drake": "drake", "genesis": "genesis-world", "gymnasium": "gymnasium", "jax": "jax",
    "newton": "newton", "numpy": "numpy", "pydrake": "drake", "taichi": "taichi", "torch": "torch", "warp": "warp-lang",
}  # fmt: skip
HEAD = (
    "what",
    "version",
    "its gradient",
    "off by",
    "jumps",
    "bias, smaller sigma",
    "bias, larger sigma",
    "cost",
    "gradient",
    "spent",
)
STORE, PAGE = HERE / "table.json", HERE.parent / "docs/examine.md"
"""The file of the rows by example, and the page with the table."""
BEGIN, END = "<!-- engines -->\n", "<!-- end -->"
"""What the page has around the table."""
MARK = "\x1eROWS "


def imported(text: str) -> list[str]:
    """Return the modules that an example imports, by their first names."""
    return sorted(set(re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE)))


def row(report: Any, version: str, example: str) -> list[str]:
    """Return what a report says, as cells; a bare function's name follows that of its example."""
    from bench.report.text import counted, duration, number

    parts = [part for part in report.check.parts if math.isfinite(part.error)] if report.check else []
    off = f"{number(100 * max(part.error for part in parts))}%" if parts and report.gradient else "-"
    judged = "not checked" if not report.gradient else "right" if report.check and report.check.trusted else "wrong"
    if report.gradient and (report.derivative == "not shown" or report.cause == "nondeterministic"):
        judged = "unknown"
    biases = [
        f"{number(100 * one.bias / one.norm)}% [{', '.join(map(number, one.bias_percent))}]" if one.known else "unknown"
        for one in report.smoothed
    ]
    biases += ["-"] * (2 - len(biases))
    spent = report.spent
    jumps = sum(len(line.jumps) for line in report.lines)
    said = f"{jumps} on {counted(len(report.lines), 'line')}" if report.lines else "not looked for"
    bare = report.name.isidentifier() and report.name not in version
    return [
        f"{example}: {report.name}" if bare else report.name, version, f"{judged} ({report.cause})", off, said, *biases[:2], duration(spent.cost_s),
        duration(spent.gradient_s) if math.isfinite(spent.gradient_s) else "-", duration(spent.seconds),
    ]  # fmt: skip


def record(path: Path) -> None:
    """Run one example and print the rows of its reports."""
    import bench

    found, examine = [], bench.examine

    def recorded(*words: Any, **settings: Any) -> Any:
        report = examine(*words, **{"progress": False, **settings})
        found.append(report)
        return report

    bench.examine = recorded
    sys.argv = [str(path)]
    runpy.run_path(str(path), run_name="__main__")
    text = path.read_text()
    names = [name for name in imported(text) if name in PACKAGES]
    first = sorted(names, key=lambda name: (name in ("numpy", "jax", "torch"), name))[:1]
    version = ", ".join(f"{PACKAGES[name]} {metadata.version(PACKAGES[name])}" for name in first)
    print(MARK + json.dumps([row(report, version, path.stem) for report in found]), flush=True)


def rows(name: str) -> tuple[list[list[str]], str]:
    """Return the rows of an example; without rows, the reason."""
    path = HERE / f"{name}.py"
    missing = [one for one in imported(path.read_text()) if importlib.util.find_spec(one) is None]
    if missing:
        return [], f"not installed: {', '.join(missing)}"
    words = [sys.executable, __file__, "--record", name]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, cwd=HERE.parent)
    except subprocess.TimeoutExpired:
        return [], f"no end after {LIMIT} s"
    text, _, found = done.stdout.partition(MARK)
    print(text, file=sys.stderr, flush=True)
    if not found:
        print(done.stderr, file=sys.stderr, flush=True)
        return [], f"failed: {(done.stderr.strip().splitlines() or ['no report'])[-1]}"
    return json.loads(found.splitlines()[0]), ""


def stored() -> dict[str, list[list[str]]]:
    """Return the stored rows by example."""
    return json.loads(STORE.read_text()) if STORE.exists() else {}


def as_text(table: dict[str, list[list[str]]]) -> str:
    """Return rows by example as a table in Markdown."""
    every = [HEAD, ["---"] * len(HEAD), *(row for name in ORDER for row in table.get(name, []))]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in every)


def write(table: dict[str, list[list[str]]]) -> None:
    """Store rows by example, and put the table into the page."""
    ordered = {name: table[name] for name in ORDER if name in table}
    STORE.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n")
    before, begin, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{before}{begin}{as_text(ordered)}{END}{rest.partition(END)[2]}")


def main() -> int:
    """Run all examples, or those named, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=ORDER, default=ORDER, metavar="NAME", help=", ".join(ORDER))
    parser.add_argument("--record", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.record:
        record(HERE / f"{chosen.record}.py")
        return 0
    status = 0
    for name in chosen.only:
        found, reason = rows(name)
        if found:
            write(stored() | {name: found})  # after each example, so that what is done is kept
        else:
            print(f"{name}: {reason}; its rows stay as they are", flush=True)
            status = max(status, int(not reason.startswith("not installed")))
    print(as_text(stored()))
    return status


if __name__ == "__main__":
    sys.exit(main())
