"""Runs random command lines in this process, to find crashes: ``python tests/programs/fuzz.py COUNT [SEED]``.

Every word is a setting with a random value, a setting with a character of its key changed, or noise. One configuration in
fifty is run, the others are planned. Prints the faults and one line of counts. Faults are a traceback, an exit status other
than 0, 1 and 2, an error message that is not one line, and escape characters. The exit status is 1 for any fault.
"""

import contextlib
import io
import random
import sys
import tempfile
import traceback

from configurations import is_refusal

from bench.cli import main
from bench.experiment.config import _known_keys

BASE = [
    "scenes=[heaviside]", "estimators=[fobg]", "backends=[numpy]", "samples=4", "repeats=3", "workers=0", "timing=false",
    "reference.samples=4096", "--quiet",
]  # fmt: skip
COSTLY = (
    "experiment",
    "samples",
    "repeats",
    "workers",
    "reference",
    "launcher",
    "results_dir",
    "compile_cache",
    "study",
)
LETTERS = "ab01.,:=[]{}()'\"~!@#$%^&*<>|\\/ +-_\u00fc\u4e2d\x1b\t"


def value(dice: random.Random, depth: int = 0) -> str:
    kind = dice.randrange(9 if depth < 2 else 6)
    if kind == 0:
        return str(dice.choice([0, 1, -1, 2**31, 2**53, 2**64, 10**400]))
    if kind == 1:
        return repr(dice.uniform(-1, 1) * 10.0 ** dice.randint(-320, 300))
    if kind == 2:
        return dice.choice(
            ["null", "true", "False", "nan", "-inf", "~", "''", "1e999", "0x1F", "2020-13-45", "!!int x", ".5", "1_0"]
        )
    if kind == 3:
        return "".join(dice.choice(LETTERS) for _ in range(dice.randrange(12)))
    if kind == 4:
        return dice.choice(
            ["fobg", "heaviside[sigma=", "reinforce[baseline=none]", "numpy[dtype=float32]", "fobg[x={]", "quadratic[]"]
        )
    if kind == 5:
        return dice.choice(["../x", "/dev/null/x", "~nosuchuser/x", "a" * 300, "con", "."])
    inner = [value(dice, depth + 1) for _ in range(dice.randrange(4))]
    if kind == 6:
        return "{" + ",".join(f"{dice.choice(['sigma', 'seed', 'a', 'zip', 'x.y'])}:{one}" for one in inner) + "}"
    return "[" + ",".join(inner) + "]"


def word(dice: random.Random, keys: list[str]) -> str:
    key = dice.choice(keys)
    if dice.random() < 0.3:
        key += "." + dice.choice(
            ["sigma", "samples", "heaviside.sigma", "zip", "union", "product", "numpy.step", "", "x"]
        )
    if dice.random() < 0.1:
        place = dice.randrange(len(key))
        key = key[:place] + dice.choice(LETTERS) + key[place + 1 :]
    return value(dice) if dice.random() < 0.05 else f"{dice.choice(['', '', '', '+', '++', '~'])}{key}={value(dice)}"


def fuzz(count: int, seed: int) -> int:
    dice, statuses, faults = random.Random(seed), dict.fromkeys((0, 1, 2), 0), 0
    keys = sorted(_known_keys() - set(COSTLY))
    for number in range(count):
        words = [word(dice, keys) for _ in range(dice.randint(1, 4))]
        verb = "run" if number % 50 == 0 else "plan"
        out, err = io.StringIO(), io.StringIO()
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = main([verb, *BASE, *words, f"results_dir={folder}/out"])
            except BaseException as error:
                status = (
                    repr(error)[:200]
                    + " "
                    + " < ".join(f"{f.filename}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)[-3:])
                )
        said = err.getvalue().strip()
        if status in statuses:
            statuses[status] += 1
        if status not in statuses or (status == 2 and not is_refusal(said)) or "Traceback" in said or "\x1b" in said:
            faults += 1
            print(f"{status}: {verb} {words!r}: {said[:300]!r}")
    print(f"{count} configurations: statuses {statuses}, {faults} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
