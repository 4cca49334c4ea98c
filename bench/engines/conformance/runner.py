"""Runs the conformance set on an engine, with NumPy only: ``python runner.py ENGINE.py [CASE ...]`` prints its rows as JSON."""

from __future__ import annotations

import copy
import difflib
import json
import runpy
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent / "cases"
TERMS = ("qpos", "qvel", "controls", "parameter")
"""The inputs by which a case is differentiated. ``qpos`` is changed by velocities, as in ``mj_integratePos``."""
LADDER = 10.0 ** np.arange(-2.0, -7.1, -0.5)
"""Steps of central differences, relative to the size of an input where that is above 1."""
DOUBTS = 10.0
"""How many times its uncertainty a derivative may be off."""
UNCERTAIN = 0.01
"""Largest such margin, relative to the derivative, at which it is right. At any margin it is wrong if it is off by more."""
EXPLAINED = 0.1
"""Largest distance to a fault's numbers, as a share of the distance to the right ones, at which an engine has the fault."""
RELATED = 0.01
"""Largest distance to changed right numbers, as a share of the error and of the wrong numbers, that explains a derivative."""
TOLERANCES = {"float64": 1e-6, "float32": 1e-3}
"""Relative tolerances by name. A penetration of 0.1 mm, 1 m from the origin, has 3 digits in float32."""
WRONG = 10
"""Exit status of a script that ran and found something wrong, or judged nothing."""
COLUMNS = (
    "case",
    "term",
    "is_right",
    "digits",
    "ratio",
    "component",
    "expected",
    "obtained",
    "uncertainty",
    "looks_like",
    "against",
    "seconds",
    "reason",
)


@dataclass(frozen=True)
class Case:
    """A model with a start, controls ``(horizon, n_u)``, a parameter, and weights of the last state, whose sum is the cost."""

    name: str
    model: Path
    """The MJCF file."""
    data: dict[str, Any] = field(repr=False)
    qpos: np.ndarray
    qvel: np.ndarray
    controls: np.ndarray
    parameter: np.ndarray

    def cost(self, qpos: Any, qvel: Any) -> Any:
        """Return the cost of a rollout whose last state this is; sums of products only, so that any array will do."""
        weights = self.data["weights"]
        return (np.array(weights["qpos"]) * qpos).sum() + (np.array(weights["qvel"]) * qvel).sum()

    def tangent(self) -> np.ndarray:
        """Return the derivative of qpos by a velocity times time, ``(n_q, n_v)``: quaternions turn in their body's frame."""
        return tangent(self.qpos, self.data["quaternions"])

    def moved(self, term: str, change: np.ndarray) -> Case:
        """Return the case with another start, controls or parameter; ``change`` is flat, and of velocities for qpos."""
        old = getattr(self, term)
        is_turned = term == "qpos"
        new: Any = moved(old, self.data["quaternions"], change) if is_turned else old + change.reshape(old.shape)
        return replace(self, **{term: new})

    def differences(self, engine: Any, term: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative by central differences of the engine's own costs, and each component's uncertainty."""
        is_turned = term == "qpos"
        size = 1.0 if is_turned else max(1.0, np.abs(getattr(self, term)).max(initial=0.0))
        basis = np.eye(self.qvel.size if is_turned else getattr(self, term).size)
        return differences(lambda change: float(engine.rollout(copy.deepcopy(self).moved(term, change))), basis, size)


def tangent(qpos: np.ndarray, quaternions: Sequence[int]) -> np.ndarray:
    """Return the derivative of positions by a velocity times time, ``(n_q, n_v)``, with quaternions at the given places."""
    result = np.delete(np.eye(qpos.size), quaternions, axis=1)
    for before, i in enumerate(quaternions):
        w, x, y, z = qpos[i : i + 4] / 2
        result[i : i + 4, i - before : i - before + 3] = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    return result


def moved(qpos: np.ndarray, quaternions: Sequence[int], change: np.ndarray) -> np.ndarray:
    """Return positions after a small motion ``(n_v,)``; rotations are about axes of the body."""
    new: np.ndarray = qpos + tangent(qpos, quaternions) @ change
    for i in quaternions:
        new[i : i + 4] /= np.linalg.norm(new[i : i + 4])
    return new


def differences(
    function: Callable[[np.ndarray], Any], basis: Iterable[np.ndarray], size: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return a function's derivatives at 0 along directions, by central differences, and each component's uncertainty.

    Each component takes the neighbouring steps of the ladder, times ``size``, whose extrapolated differences agree best. Their
    disagreement is the uncertainty, or the disagreement at a smaller step if that is larger for its step: rounding grows as
    1 / step. Steps at which the function no longer changes do not count.
    """
    slopes = np.array([[(function(h * e) - function(-h * e)) / (2 * h) for e in basis] for h in LADDER * size])
    better = (10 * slopes[1:] - slopes[:-1]) / 9  # the ladder's factor is the root of 10, the error of order 2
    steps = size * LADDER[2:].reshape(-1, *[1] * (slopes.ndim - 1))
    gaps = np.abs(np.diff(better, axis=0)) * steps
    gaps = np.maximum.accumulate(gaps[::-1])[::-1] / steps
    gaps[(slopes[2:] == 0) & slopes.any(axis=0)] = np.inf
    best = gaps.argmin(axis=0)[None]
    return np.take_along_axis(better[1:], best, 0)[0], np.take_along_axis(gaps, best, 0)[0]


def cases(*names: str) -> list[Case]:
    """Return the named cases, or all. Raises :class:`ValueError` for a name that is not a case's."""
    result, known = [], sorted(file.stem for file in FOLDER.glob("*.json"))
    for name in names or known:
        if name not in known:
            near = "".join(f", did you mean {other}?" for other in difflib.get_close_matches(name, known, 1))
            raise ValueError(f"there is no case {name!r}{near}; cases: {', '.join(known)}")
        file = FOLDER / f"{name}.json"
        data = json.loads(file.read_text())
        given = (*(data[term] for term in TERMS[:3]), data["parameter"]["value"])
        inputs = (np.array(values, dtype=float) for values in given)
        result.append(Case(name, file.with_suffix(".xml"), data, *inputs))
    return result


def check(engine: Any, case: Case) -> list[dict[str, Any]]:
    """Return a row for the value and for each derivative that the engine gives of a case.

    A case in ``engine.differs``, with its reason, is compared with the engine's own differences.
    """
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {"case": case.name, "term": "all", "looks_like": "", "against": "", "reason": ""}
    started = time.perf_counter()
    try:
        # each call gets a case of its own, since an engine may write into its arrays
        results = {"value": engine.rollout(copy.deepcopy(case)), **engine.gradient(copy.deepcopy(case))}
        if strange := set(results) - {"value", *TERMS}:
            raise ValueError(f"{', '.join(map(repr, sorted(strange)))} is not one of {', '.join(TERMS)}")
        seconds, differs = time.perf_counter() - started, getattr(engine, "differs", {}).get(case.name, "")
        row |= {"against": "own differences" if differs else "the set", "seconds": round(seconds, 4), "reason": differs}
        return [row | {"term": term} | _verdict(engine, case, term, found, differs) for term, found in results.items()]
    except Exception as error:  # another engine's code may raise anything
        is_right = None if isinstance(error, NotImplementedError) else False
        return [row | {"is_right": is_right, "reason": f"{type(error).__name__}: {error}"}]


def _verdict(engine: Any, case: Case, term: str, found: Any, differs: str) -> dict[str, Any]:
    """Return the columns of a value or derivative that depend on its numbers."""
    result = np.ravel(np.array(found, dtype=float))
    if term == "qpos" and result.size > case.qvel.size:
        result = result @ case.tangent()
    expected, doubt, faults = (case.data[name] for name in ("expected", "certainty", "faults"))
    others = {other: np.ravel(numbers) for other, numbers in expected.items() if other != term}
    expected, doubt = np.ravel(expected[term]), doubt[term]
    if differs:
        expected, doubt = (expected, np.inf) if term == "value" else case.differences(engine, term)
        faults = others = {}
    if result.size != expected.size:
        return {"is_right": False, "reason": f"{result.size} numbers instead of {expected.size}"}
    if strange := result.size - int(np.isfinite(result).sum()):
        return {"is_right": False, "reason": f"{strange} of {result.size} numbers not finite"}
    if not np.isfinite(expected).all():
        return {"is_right": None, "reason": "own differences are not finite"}
    tolerance, scale = getattr(engine, "tolerance", "float64"), np.abs(expected).max(initial=1e-9)
    if isinstance(tolerance, str) and tolerance not in TOLERANCES:
        raise ValueError(f"{tolerance=} is not a number or one of {', '.join(TOLERANCES)}")
    error, margin = np.abs(result - expected), DOUBTS * (doubt + 0.0 * expected)
    limit = TOLERANCES.get(tolerance, tolerance) * scale + margin
    off, is_off = error.max(), error > limit
    worst = int(np.where(is_off.any(), error * is_off, error).argmax())
    near = [name for name, by in faults.items() if np.abs(result - by.get(term, np.inf)).max() <= EXPLAINED * off]
    numbers = {
        "ratio": result @ expected / (expected @ expected) if expected.any() else np.nan,
        "expected": expected[worst],
        "obtained": result[worst],
        "uncertainty": margin[worst] / DOUBTS,
    }
    row = {
        "is_right": True if margin.max() <= UNCERTAIN * scale else None,
        "digits": round(float(-np.log10(max(off / scale, 1e-16))), 1),
        **{name: float(f"{number:.12g}") if np.isfinite(number) else None for name, number in numbers.items()},
        "component": worst,
    }
    if not is_off.any():
        return row
    n_rows = len(case.controls) if term == "controls" else result.size
    reason = _explained(term, result, expected, limit, others, n_rows)
    return row | {"is_right": False, "looks_like": " or ".join(near), "reason": reason}


def _explained(
    term: str, result: np.ndarray, right: np.ndarray, limit: np.ndarray, others: dict[str, np.ndarray], n_rows: int
) -> str:
    """Return how wrong numbers are related to the right ones: a factor, other numbers of the case, or another order."""
    error = np.abs(result - right)
    is_off, rows = error > limit, right.reshape(n_rows, -1)
    worst, few = int((error * is_off).argmax()), 2 * is_off.sum() <= is_off.size
    where = f"{term}{'' if few else ' except '}{np.flatnonzero(is_off == few).tolist()}"
    guesses = {"0": 0 * right} | {f"the numbers of {other}": by for other, by in others.items()}
    for place, own in (("", is_off | True), (f"{where}: ", is_off)):
        factor = result[own] @ right[own] / max(right[own] @ right[own], 1e-300)
        guesses[f"{place}{factor:.7g} times" if factor else f"{place}0"] = np.where(own, factor * right, right)
    for step, outer in ((1, 0), (-1, -1)) if n_rows > 2 else ():
        shifted = np.roll(rows, step, 0)
        shifted[outer] = result.reshape(rows.shape)[outer]
        guesses[f"shifted by {step:+d}"] = shifted.ravel()
    order = np.argsort(right)[np.argsort(np.argsort(result))]
    guesses[f"in the order {order.tolist()}"] = right[order]
    allowed = limit + RELATED * min(error.max(), np.abs(result[is_off]).max())
    for guess, numbers in guesses.items():
        if numbers.size == result.size and (np.abs(result - numbers) <= allowed).all():
            return guess
    where = f"{term}[{worst}]" if is_off.all() else where
    return f"{where}: {result[worst]:.6g} instead of {right[worst]:.6g}"


def run(engine: Any, *names: str) -> list[dict[str, Any]]:
    """Return the rows of an engine with ``rollout(case)``, a cost, and ``gradient(case)``, its derivatives by :data:`TERMS`."""
    return [row for case in cases(*names) for row in check(engine, case)]


def verify(rows: list[dict[str, Any]], judged: int = 1) -> None:
    """Raise :class:`AssertionError` if a row is wrong, or if fewer than ``judged`` derivatives are right or wrong."""
    texts = [f"{row['case']} {row['term']}: {row['reason']}" for row in rows if row["is_right"] is False]
    if text := "\n".join(filter(None, [*texts, too_few(rows, judged)])):
        raise AssertionError(text)


def too_few(rows: list[dict[str, Any]], judged: int) -> str:
    """Return how many derivatives are right or wrong if these are fewer than ``judged``, otherwise nothing."""
    number = sum(row["is_right"] is not None and row["term"] in TERMS for row in rows)
    return f"{number} derivatives are judged, {judged} are required" if number < judged else ""


def load(path: str, name: str) -> dict[str, Any]:
    """Return what a file defines. Ends this process if the file does not exist or has no class ``name``."""
    sys.path.append(str(Path(path).parent))  # last: a file may have the name of a library
    try:
        module = runpy.run_path(path)
    except OSError as error:
        sys.exit(f"{path}: {error.strerror}")
    return module if name in module else sys.exit(f"{path} has no class {name}")


def printed(versions: dict[str, str], rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Print versions and rows as JSON, each on a line as soon as it is known, and return the rows."""
    print(json.dumps({"versions": versions}))
    result = []
    for row in rows:
        print(json.dumps(row), flush=True)
        result.append(row)
    return result


def main(path: str, *names: str) -> None:
    """Print the versions and the rows of the class ``Engine`` of a file as JSON, each on a line as soon as it is known."""
    try:
        own = cases(*names)
    except ValueError as error:
        sys.exit(str(error))
    engine = load(path, "Engine")["Engine"]()
    rows = printed(getattr(engine, "versions", {}), (row for case in own for row in check(engine, case)))
    try:
        verify(rows)
    except AssertionError as error:
        print(error, file=sys.stderr)
        sys.exit(WRONG)


if __name__ == "__main__":
    main(*sys.argv[1:]) if sys.argv[1:] else sys.exit(__doc__)
