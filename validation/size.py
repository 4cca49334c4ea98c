"""Count the Python tokens of each package, without comments and docstrings: ``python validation/size.py [--lower]``.

Fails where a count is above its ceiling in ``validation/size.json``. ``--lower`` lowers the ceilings to the present
counts. A ceiling is raised by hand, with a sentence in the changelog.
"""

from __future__ import annotations

import ast
import io
import json
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = Path(__file__).with_suffix(".json")
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


def counts() -> dict[str, int]:
    """Return the tokens of each package: a folder of ``bench``, ``plugins`` or ``tests``, or another folder as a whole."""
    result: Counter[str] = Counter()
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        first, *inner = path.relative_to(ROOT).parts
        is_split = first in FOLDERS[:3] and len(inner) > 1
        result[f"{first}/{inner[0]}" if is_split else first] += count(path.read_text())
    return dict(sorted(result.items()))


def main() -> int:
    """Print each package with its tokens, its ceiling and whether it is above; return 1 if one is."""
    present = counts()
    ceilings = json.loads(CEILINGS.read_text()) if CEILINGS.exists() else {}
    if "--lower" in sys.argv:
        ceilings = {name: min(tokens, ceilings.get(name, tokens)) for name, tokens in present.items()}
        CEILINGS.write_text(json.dumps(ceilings, indent=1) + "\n")
    above = {name for name, tokens in present.items() if tokens > ceilings.get(name, 0)}
    for name, tokens in present.items():
        print(f"{name:24}{tokens:8,}{ceilings.get(name, 0):8,}{'  above its ceiling' * (name in above)}")
    print(f"{'total':24}{sum(present.values()):8,}")
    return int(bool(above))


if __name__ == "__main__":
    sys.exit(main())
