"""Plants the faults of `mutants.txt` in the core and reports which of them a test detects: `python validation/mutants.py [WORD ...]`.

Each fault whose file or text contains a word is planted in a copy of the tree. Its tests run until one fails, in a process
forked after the libraries are loaded. Run by hand: all faults take half an hour.
"""

import os
import resource
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

CPU, MEMORY = 90, 6 << 30
"""Limits for the tests of one fault: CPU seconds, and bytes of address space."""
ROOT = Path(__file__).resolve().parents[1]
COPIED = ("bench", "plugins", "conf", "tests", "validation", "docs", "README.md", "CONTRIBUTING.md", "pyproject.toml")


class Fault(NamedTuple):
    """A source line, its faulty replacement, and the tests that should fail."""

    path: str
    old: str
    new: str
    tests: str


def planted(table):
    """Yield the faults of a table: ``== FILE: TESTS`` begins a group, and a fault is lines with ``-`` for the old and ``+`` for the new."""
    for group in table.removeprefix("== ").split("\n== "):
        head, *blocks = group.strip("\n").split("\n\n")
        path, _, tests = head.partition(": ")
        for block in blocks:
            lines = block.split("\n")
            old, new = ("\n".join(line[1:] for line in lines if line[0] == sign) for sign in "-+")
            yield Fault(path, old, new, tests)


FAULTS = list(planted(Path(__file__).with_suffix(".txt").read_text()))
"""Faults that change no number are omitted, such as in code that only speeds up a search, or a quadrature that may stop below its
least number of points: it never stops before the second level, which has that many."""


def killed(fault, folder):
    """Plant the fault in the copy at ``folder``, run its tests in a forked process, and return whether one failed."""
    path = folder / fault.path
    text = path.read_text()
    path.write_text(text.replace(fault.old, fault.new))
    child = os.fork()
    if child == 0:
        code = 99
        try:
            import pytest

            # a fault may loop or fill the memory: the limits make its tests fail
            resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            os.chdir(folder)
            sys.path.insert(0, str(folder))
            sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            code = int(pytest.main(["-x", "-n", "0", "-q", "-p", "no:cacheprovider", *shlex.split(fault.tests)]))
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    path.write_text(text)
    code = os.waitstatus_to_exitcode(status)
    if code > 2:
        print(f"  tests of {fault.path} ended with {code}")
    return code != 0


def stale(faults):
    """Return a message per fault that cannot be planted, since the code does not contain its text exactly once."""
    held = {path: (ROOT / path).read_text() for path in {fault.path for fault in faults}}
    return [f"{f.path} does not hold exactly one: {f.old}" for f in faults if held[f.path].count(f.old) != 1]


def main(words):
    """Run the faults whose file or text contains one of the words, or all; return 1 if any survives."""
    chosen = [fault for fault in FAULTS if not words or any(word in f"{fault.path} {fault.old}" for word in words)]
    if lost := stale(chosen):
        raise SystemExit("\n".join(lost))
    # imported once, before forking
    import pandas  # noqa: F401
    import pytest  # noqa: F401
    import scipy.special
    import scipy.stats  # noqa: F401

    survivors = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in COPIED:
            source = ROOT / part
            ignored = shutil.ignore_patterns("__pycache__")
            if source.is_dir():
                shutil.copytree(source, folder / part, ignore=ignored)
            else:
                shutil.copy(source, folder / part)
        own = (ROOT, ROOT / "tests", ROOT / "validation")
        sys.path[:] = [path for path in sys.path if Path(path or ".").resolve() not in own]
        sys.dont_write_bytecode = True
        for tests in dict.fromkeys(fault.tests for fault in chosen):
            if killed(chosen[0]._replace(new=chosen[0].old, tests=tests), folder):
                raise SystemExit(f"{tests} fails without any fault: mend that first")
        for fault in chosen:
            started = time.perf_counter()
            is_killed = killed(fault, folder)
            survivors += [] if is_killed else [fault]
            description = f"{fault.path}: {fault.old.strip()[:70]} -> {fault.new.strip()[:50]}"
            verdict = "killed  " if is_killed else "SURVIVED"
            print(f"{verdict} {time.perf_counter() - started:5.1f}s  {description}", flush=True)
    print(f"{len(chosen) - len(survivors)} of {len(chosen)} faults killed")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
