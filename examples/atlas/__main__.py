"""Puts simulators that others wrote to ``examine``: ``python -m examples.atlas [install | examine | page] [NAME ...]``.

Each other file here is a simulator, with its facts in ``about``: the package, the environment that it shares and what pip
installs into it, the settings of ``examine``, the answers that the truth demands, and how ``truth()`` knows the derivative.
``install`` makes the environments like those of engines, ``examine`` writes a JSON per simulator into ``reports``,
``page`` writes ``README.md`` here from them. The environment ``bench`` is the Python that runs this.
"""

import ast
import datetime
import json
import math
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import bench
from bench.engines import environments
from bench.errors import Unavailable, UserError, printable
from bench.examine import command
from bench.report.text import number
from bench.simulator import imports

FOLDER = Path(__file__).parent
ROOT, REPORTS = FOLDER.parents[1], FOLDER / "reports"
PAGE = FOLDER / "README.md"
LIMIT_S = 900.0
"""Time allowed for one simulator; most of it compiles."""
ALIKE = 1e-3
"""Largest distance from the truth of a right gradient, relative to its largest component: solvers have tolerances."""
WORDS = ("unavailable", "crashed", "TRUTH DIFFERS", "FALSE ALARM", "MISSED", "misnamed", "open", "agrees")
OPEN = ("not shown", "not measured")
GOOD = ("right", "usable", "no jumps")
INTRODUCTION = """\
# Simulators that others wrote

You can read here what `bench.examine` says of {count} packages, used as their documentation shows or as one writes it first, beside the truth, which
`truth()` in the file of each simulator computes. Answers: {score}.

    python -m examples.atlas install NAME    # NAME is a file here without .py; some packages share an environment
    python -m examples.atlas examine NAME    # without names all; then `page` writes this page

<!-- figures: python -m examples.atlas page -->
*off* is the largest distance of the package's derivative from the truth, relative to the largest component, and *s* processor seconds with
compilation. The truth is differentiated by complex steps. The verdict is empty if `examine` agrees with the truth. Last examined on {date}. Not
examined: jax-fem, which needs PETSc, fdtdx, rewarped and playground.
"""


def names():
    """Return the simulators' names."""
    return sorted(path.stem for path in FOLDER.glob("[a-z]*.py"))


def about(name):
    """Return the facts of a simulator without importing it; its first line is ``what``."""
    tree = ast.parse((FOLDER / f"{name}.py").read_text())
    (facts,) = (n.value for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "about")
    return {"name": name, "what": ast.get_docstring(tree).splitlines()[0].rstrip("."), **ast.literal_eval(facts)}


def python_of(facts):
    """Return the Python that has a simulator's package; it may not exist."""
    return sys.executable if facts["python"] == "bench" else str(environments.python_of(f"atlas-{facts['python']}"))


def install(name):
    """Install what a simulator and ``examine`` require into its environment; this Python is as it is."""
    facts = about(name)
    if facts["python"] == "bench":
        return
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join([*facts["requires"].split(), "scipy"]))
        file.flush()
        environments.install(f"atlas-{facts['python']}", Path(file.name))


def examine(name):
    """Examine a simulator in its Python and store the answers; without the package they are ``unavailable``."""
    facts = about(name)
    row = {"name": name, "date": str(datetime.date.today()), "python": facts["python"]}
    place = REPORTS / f"{name}.json"
    python = python_of(facts)
    try:
        row["version"] = environments.library_versions(python, (facts["package"],))[facts["package"]]
        words = [python, "-m", "examples.atlas", "report", name, str(place)]
        place.unlink(missing_ok=True)
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, errors="replace", timeout=LIMIT_S)
        row |= json.loads(place.read_text()) if place.exists() else {"derivative": "crashed", "reason": _tail(done)}
    except (KeyError, Unavailable) as error:
        row |= {"derivative": "unavailable", "reason": f"{python} has no {facts['package']} ({error})"}
    except subprocess.TimeoutExpired:
        row |= {"derivative": "crashed", "reason": f"longer than {LIMIT_S:g} s"}
    place.write_text(json.dumps(row, indent=1) + "\n")
    return row


def _tail(done):
    return f"status {done.returncode}: {printable(done.stderr)[-300:]}"


def report(name, place):
    """Write the answers of ``examine`` and the distance of checked inputs from the truth; runs in the Python that has the package."""
    file = str(FOLDER / f"{name}.py")
    found = command.run([f"{file}:cost", *about(name)["examine"].split(), "--quiet"])
    parts = found.check.components
    gradient = np.array([part.program if found.gradient else part.difference for part in parts])
    truth = np.ravel(np.asarray(imports.load_module(file).truth(), float))[[part.component for part in parts]]
    off = float(np.max(np.abs(gradient - truth)) / (np.max(np.abs(truth)) or 1.0))
    used = resource.getrusage(resource.RUSAGE_SELF)
    facts = {
        "bench": bench.__version__,
        "seconds": round(used.ru_utime + used.ru_stime, 1),
        "status": found.status,
        "derivative": found.derivative,
        "use": found.use if found.gradient and found.setup.levels else "",
        "cause": found.derivative_cause,
        "jumps": "jumps" if any(line.jumps for line in found.lines) else "no jumps",
        "conclusion": found.conclusion,
        "noise": found.noise_answer,
        "gradient": [f"{x:.9g}" for x in gradient[:8]],
        "truth": [f"{x:.9g}" for x in truth[:8]],
        "off": off if math.isfinite(off) else None,
    }
    Path(place).write_text(json.dumps(facts))


def agreement(facts, row):
    """Return how the answers of a report compare with those that the truth demands, the worst first."""
    found = {_compare(facts.get(answer), row.get(answer)) for answer in ("derivative", "use", "jumps")}
    is_far = "off" in row and (row["off"] is None or row["off"] > ALIKE)
    if "off" in row and is_far != (facts["derivative"] == "wrong"):
        found.add("TRUTH DIFFERS")
    return next(word for word in WORDS if word in found)


def _compare(expected, reported):
    if expected in (reported, None):
        return "agrees"
    if reported in (None, "unavailable", "crashed"):
        return reported or "open"
    if reported in OPEN:
        return "open"
    return "MISSED" if reported in GOOD else "FALSE ALARM" if expected in GOOD else "misnamed"


def page():
    """Return the page of all stored reports."""
    rows = {path.stem: json.loads(path.read_text()) for path in REPORTS.glob("*.json")}
    facts = sorted((about(name) for name in rows), key=lambda each: (each["package"], each["what"]))
    words = {each["name"]: agreement(each, rows[each["name"]]) for each in facts}
    intro = INTRODUCTION.format(
        count=len({each["package"] for each in facts}),
        date=max(row["date"] for row in rows.values()),
        score=", ".join(f"{n} {word.removesuffix('s')}" for word, n in Counter(words.values()).most_common()),
    )
    table = ["| package | simulator | `examine` says | truth | off | verdict | s |", "|---|---|---|---|--:|---|--:|"]
    for each in facts:
        row = rows[each["name"]]
        said = [row["derivative"], row.get("use"), each.get("jumps") and row.get("jumps"), f"`{row.get('cause')}`"]
        off = f"{number(100 * row['off'], 1)}%" if row.get("off") is not None else "-"
        cells = [
            f"{each['package']} {row.get('version', '')}",
            f"[{each['what']}]({each['name']}.py)",
        ]
        cells += [
            ", ".join(filter(None, said)),
            each["how"],
            off,
            words[each["name"]].replace("agrees", ""),
            f"{row.get('seconds', 0):.0f}",
        ]
        table.append(f"| {' | '.join(cells)} |")
    advice = [f"- **{each['package']}**: {each['advice']}" for each in facts if "advice" in each]
    return "\n".join([intro, *table, "", "## What users should know", "", "<!-- figures: given -->", *advice]) + "\n"


def main(words):
    """Run the command line and return the exit status: 1 if an answer is not that of the truth, nor as stored, or pip fails."""
    match words:
        case ["report", name, place]:
            report(name, place)
        case ["page"]:
            PAGE.write_text(page())
        case ["install" | "examine" as verb, *chosen]:
            return max(_one(verb, name) for name in chosen or names())
        case _:
            raise UserError(__doc__.splitlines()[0])
    return 0


def _one(verb, name):
    try:
        if verb == "install":
            install(name)
            return 0
        facts, place = about(name), REPORTS / f"{name}.json"
        known = agreement(facts, json.loads(place.read_text())) if place.exists() else "agrees"
        word = agreement(facts, row := examine(name))
    except UserError as error:
        print(f"{name}: {error}", flush=True)
        return 1
    print(f"{name}: {word}. {row.get('conclusion') or row['reason']} {row.get('noise', '')}", flush=True)
    return int(word not in (known, "agrees", "open", "unavailable"))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
