"""Count the Python tokens of each package, without comments and docstrings: ``python validation/size.py [--lower]``.

A package is paths with one purpose, in ``validation/size.json``: why it is there, the tokens that it should have (``goal``)
and those that it may have (``ceiling``). Fails above a ceiling; ``--lower`` lowers the ceilings to the present counts. One is
raised by hand, with a sentence in the changelog.
"""

from __future__ import annotations

import ast
import io
import json
import sys
import tokenize
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = Path(__file__).with_suffix(".json")
FOLDERS = ("bench", "plugins", "tests", "validation", "docs", "examples")
LAYOUT = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENDMARKER}


def count(source: str) -> int:
    """Return the number of tokens of a source text."""
    bodies = [node.body for node in ast.walk(ast.parse(source)) if isinstance(getattr(node, "body", None), list)]
    texts = [part for body in bodies for part in body if isinstance(part, ast.Expr) and _is_text(part.value)]
    lines = {line for part in texts for line in range(part.lineno, (part.end_lineno or part.lineno) + 1)}
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return sum(t.type not in LAYOUT and not (t.type == tokenize.STRING and t.start[0] in lines) for t in tokens)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def counts(packages: dict[str, Any]) -> Counter[str]:
    """Return the tokens of each package; a file belongs to the longest path of a package that begins its own."""
    owners = {path: name for name, package in packages.items() for path in package["holds"].split()}
    result: Counter[str] = Counter()
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        relative = path.relative_to(ROOT)
        owner = next(str(part) for part in (relative, *relative.parents) if str(part) in owners)
        result[owners[owner]] += count(path.read_text())
    return result


def main() -> int:
    """Print each package with its tokens, its ceiling and how far it is from its goal; return 1 if one is above its ceiling."""
    packages = json.loads(BUDGETS.read_text())
    present = counts(packages)
    if "--lower" in sys.argv:
        for name, package in packages.items():
            package["ceiling"] = min(present[name], package["ceiling"])
        BUDGETS.write_text(json.dumps(packages, indent=1) + "\n")
    above = {name for name, package in packages.items() if present[name] > package["ceiling"]}
    print(f"{'package':12}{'tokens':>9}{'ceiling':>9}{'to goal':>9}  why")
    for name, package in packages.items():
        far = min(0, package["goal"] - present[name])
        mark = "ABOVE ITS CEILING: " * (name in above)
        print(f"{name:12}{present[name]:9,}{package['ceiling']:9,}{far:9,}  {mark}{package['why']}")
    print(f"{'all':12}{present.total():9,}")
    return int(bool(above))


if __name__ == "__main__":
    sys.exit(main())
