"""Runs the conformance set on an engine, with NumPy only: ``python runner.py ENGINE.py [CASE ...]`` prints its rows as JSON."""

from __future__ import annotations

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
TOLERANCES = {"float64": 1e-6, "float32": 1e-3}
"""Relative tolerances by name. A penetration of 0.1 mm, 1 m from the origin, has 3 digits in float32."""
COLUMNS = (
    "case", "term", "is_right", "digits", "ratio", "component", "expected", "obtained", "uncertainty", "looks_like",
    "against", "seconds", "reason",
)  # fmt: skip


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
        return differences(lambda change: float(engine.rollout(self.moved(term, change))), basis, size)


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
        results = {"value": engine.rollout(case), **engine.gradient(case)}
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
    tolerance = getattr(engine, "tolerance", "float64")
    error, scale, margin = (
        np.abs(result - expected),
        np.abs(expected).max(initial=1e-9),
        DOUBTS * (doubt + 0.0 * expected),
    )
    is_off = error > TOLERANCES.get(tolerance, tolerance) * scale + margin
    off, worst = error.max(), int(np.where(is_off.any(), error * is_off, error).argmax())
    is_known, is_wrong = bool(np.isfinite(expected).all()), not np.isfinite(result).all() or bool(is_off.any())
    is_right = False if is_wrong else True if is_known and margin.max() <= UNCERTAIN * scale else None
    near = [name for name, by in faults.items() if np.abs(result - by.get(term, np.inf)).max() <= EXPLAINED * off]
    ratio = result @ expected / (expected @ expected) if expected.any() else np.nan
    numbers = {
        "ratio": ratio,
        "expected": expected[worst],
        "obtained": result[worst],
        "uncertainty": margin[worst] / DOUBTS,
    }
    return {
        "is_right": is_right,
        "digits": round(float(-np.log10(max(off / scale, 1e-16))), 1) if np.isfinite(off) else None,
        **{name: float(f"{number:.12g}") if np.isfinite(number) else None for name, number in numbers.items()},
        "component": worst,
        "looks_like": " or ".join(near) if is_wrong else "",
        **({} if is_known else {"reason": "own differences are not finite"}),
        **({"reason": _explained(term, result, expected, is_off, others)} if is_wrong else {}),
    }


def _explained(
    term: str, result: np.ndarray, expected: np.ndarray, is_off: np.ndarray, others: dict[str, np.ndarray]
) -> str:
    """Return how wrong numbers are related to the right ones: a factor, other numbers of the case, or an order of their own."""
    if strange := result.size - int(np.isfinite(result).sum()):
        return f"{strange} of {result.size} numbers not finite"
    part: Any = ...
    where = ""
    if 0 < is_off.sum() < is_off.size:
        is_few = 2 * is_off.sum() <= is_off.size
        part, where = is_off, f"{'' if is_few else ' except '}{np.flatnonzero(is_off == is_few).tolist()}"
    for own, place in ((..., ""), (part, where)):
        found, right = result[own], expected[own]
        factor = found @ right / max(right @ right, 1e-300)
        guesses = {f"{factor:.7g} times" if found.any() else "0": factor * right}
        if not place and found.size > 1:
            same = {f"the numbers of {other}": number for other, number in others.items() if number.size == found.size}
            guesses |= same | {"in reverse order": right[::-1]}
            guesses |= {f"shifted by {step:+d}": np.roll(right, step) for step in (1, -1) if found.size > 2}
        for guess, numbers in guesses.items():
            inner = slice(1, -1) if guess.startswith("shifted") else ...
            if np.abs(found - numbers)[inner].max() <= EXPLAINED * np.abs(found - right)[inner].max():
                return f"{term}{place}: {guess}" if place else guess
    worst = (np.abs(result - expected) * is_off).argmax()
    return f"{term}{where or [int(worst)]}: {result[worst]:.6g} instead of {expected[worst]:.6g}"


def run(engine: Any, *names: str) -> list[dict[str, Any]]:
    """Return the rows of an engine with ``rollout(case)``, a cost, and ``gradient(case)``, its derivatives by :data:`TERMS`."""
    return [row for case in cases(*names) for row in check(engine, case)]


def verify(rows: list[dict[str, Any]], judged: int = 1) -> None:
    """Raise :class:`AssertionError` if a row is wrong, or if fewer than ``judged`` derivatives are right or wrong."""
    texts = [f"{row['case']} {row['term']}: {row['reason']}" for row in rows if row["is_right"] is False]
    number = sum(row["is_right"] is not None and row["term"] in TERMS for row in rows)
    texts += [f"{number} derivatives are judged, {judged} are required"] * (number < judged)
    if texts:
        raise AssertionError("\n".join(texts))


def main(path: str, *names: str) -> None:
    """Print the versions and the rows of the class ``Engine`` of a file as JSON, each on a line as soon as it is known."""
    try:
        own = cases(*names)
    except ValueError as error:
        sys.exit(str(error))
    sys.path.append(str(Path(path).parent))  # last: a file may have the name of a library
    engine = runpy.run_path(path)["Engine"]()
    print(json.dumps({"versions": getattr(engine, "versions", {})}))
    for case in own:
        for row in check(engine, case):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
