"""Count words and names that CONTRIBUTING.md bans: ``python tests/programs/words.py [--lower]``.

The rules are the two tables of the section "Words": phrases in backticks in the column "do not say", counted in docstrings
and messages, and names in the column "not", counted where an identifier is defined. The exit status is 1 if a count is above
its ceiling in ``words.json``. ``--lower`` lowers the ceilings to the present counts.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CEILINGS = Path(__file__).with_suffix(".json")
FOLDERS = ("bench", "plugins")
ANY_WORD = r"(?!longer\b|more\b|less\b|better\b|worse\b|other\b)[a-z]+"
"""Pattern for a word in capitals in a phrase. Words such as "longer" are excluded, since "is no longer" is plain English."""
Place = tuple[Path, int]


def tables(text: str) -> list[list[str]]:
    """Return the second cell of each row, by table, of the tables in the section "Words"."""
    section = text.partition("\n## Words\n")[2].partition("\n## ")[0]
    blocks = re.findall(r"(?:^\|.*\n)+", section + "\n", re.MULTILINE)
    return [[line.split("|")[2] for line in block.splitlines()[2:]] for block in blocks]


def rules(text: str) -> tuple[dict[str, re.Pattern[str]], set[str]]:
    """Return banned phrases with their patterns, and banned names, from the text of CONTRIBUTING.md."""
    phrases, names = ([phrase for cell in cells for phrase in re.findall("`([^`]+)`", cell)] for cells in tables(text))
    return {phrase: pattern(phrase) for phrase in phrases}, set(names)


def pattern(phrase: str) -> re.Pattern[str]:
    """Return the pattern of a phrase: whole words in any case, with any white space between them."""
    words = [ANY_WORD if word.isupper() else re.escape(word) for word in phrase.split()]
    return re.compile(r"(?<![\w-])" + r"\s+".join(words) + r"(?![\w-])", re.IGNORECASE)


def sentences(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of every docstring and message, without code in backticks.

    A message is a string of more than one word. Values inside an f-string become braces.
    """
    inside_fstrings = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        text = ""
        if isinstance(node, ast.JoinedStr):
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside_fstrings:
            text = node.value
        text = re.sub(r"``[^`]*``|`[^`]*`", "", text)
        if isinstance(node, ast.expr) and " " in text.strip():
            yield node.lineno, text


def identifiers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of every definition of a function, class, argument, variable or attribute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def violations(paths: list[Path], contributing: str) -> dict[str, list[Place]]:
    """Return the places that break each rule, by its phrase or by ``name: NAME``."""
    phrases, names = rules(contributing)
    places: dict[str, list[Place]] = defaultdict(list)
    for path in paths:
        tree = ast.parse(path.read_text())
        for line, text in sentences(tree):
            for phrase, searched in phrases.items():
                places[phrase] += [(path, line)] * len(searched.findall(text))
        for line, name in identifiers(tree):
            if name.strip("_") in names:
                places[f"name: {name.strip('_')}"].append((path, line))
    return {rule: places[rule] for rule in [*phrases, *(f"name: {name}" for name in sorted(names))]}


def main(arguments: list[str]) -> int:
    """Print the rules broken more often than their ceilings allow, with places; returns the exit status."""
    paths = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    broken = violations(paths, (ROOT / "CONTRIBUTING.md").read_text())
    ceilings = json.loads(CEILINGS.read_text())
    above = {rule: places for rule, places in broken.items() if len(places) > ceilings.get(rule, 0)}
    for rule, places in above.items():
        print(f"'{rule}' {len(places)} times, the ceiling is {ceilings.get(rule, 0)}; see CONTRIBUTING.md, Words:")
        print("".join(f"  {path.relative_to(ROOT)}:{line}\n" for path, line in places), end="")
    if "--lower" in arguments:
        lowered = {rule: min(len(places), ceilings.get(rule, 0)) for rule, places in broken.items()}
        CEILINGS.write_text(json.dumps({rule: n for rule, n in lowered.items() if n}, indent=1, sort_keys=True) + "\n")
    total, allowed = sum(map(len, broken.values())), sum(ceilings.values())
    print(
        f"words: {total} banned words and names, {allowed} allowed, {len(above)} of {len(broken)} rules above their ceilings"
    )
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
