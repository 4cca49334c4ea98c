"""Runs the conformance set on an engine, with NumPy only: ``python runner.py ENGINE.py [CASE ...]`` prints the rows as JSON."""

from __future__ import annotations

import dataclasses
import json
import runpy
import sys
import time
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
"""Largest such margin, relative to the derivative, at which it is judged."""
EXPLAINED = 0.1
"""Largest distance to a fault's numbers, as a share of the distance to the right ones, at which an engine has the fault."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A model with a start, controls ``(horizon, n_u)``, a parameter, and weights of the last state, whose sum is the cost."""

    name: str
    data: dict[str, Any] = dataclasses.field(repr=False)
    qpos: np.ndarray
    qvel: np.ndarray
    controls: np.ndarray
    parameter: np.ndarray

    @property
    def model(self) -> Path:
        """The MJCF file."""
        return FOLDER / f"{self.name}.xml"

    def cost(self, qpos: Any, qvel: Any) -> Any:
        """Return the cost of a rollout whose last state this is; sums of products only, so that any array will do."""
        weights = self.data["weights"]
        return (np.array(weights["qpos"]) * qpos).sum() + (np.array(weights["qvel"]) * qvel).sum()

    def tangent(self) -> np.ndarray:
        """Return the derivative of qpos by a velocity times time, ``(n_q, n_v)``: quaternions turn in their body's frame."""
        result, row, column = np.zeros((self.qpos.size, self.qvel.size)), 0, 0
        while row < len(result):
            block = np.eye(1)
            if row in self.data["quaternions"]:
                w, x, y, z = self.qpos[row : row + 4]
                block = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) / 2
            end, last = row + len(block), column + block.shape[1]
            result[row:end, column:last] = block
            row, column = end, last
        return result

    def moved(self, term: str, change: np.ndarray) -> Case:
        """Return the case with another start, controls or parameter; ``change`` is flat, and of velocities for qpos."""
        if term != "qpos":
            old = getattr(self, term)
            return dataclasses.replace(self, **{term: old + change.reshape(old.shape)})
        qpos = self.qpos + self.tangent() @ change
        for i in self.data["quaternions"]:
            qpos[i : i + 4] /= np.linalg.norm(qpos[i : i + 4])
        return dataclasses.replace(self, qpos=qpos)

    def differences(self, engine: Any, term: str) -> tuple[np.ndarray, float]:
        """Return the derivative by central differences of the engine's own costs, and its uncertainty.

        Each component takes the neighbouring steps of the ladder whose extrapolated differences agree best. Their disagreement
        is the uncertainty, or the disagreement at a smaller step if that is larger for its step: rounding grows as 1 / step. Steps
        at which a cost no longer changes do not count.
        """
        basis = np.eye(self.qvel.size if term == "qpos" else getattr(self, term).size)
        steps = LADDER * (1.0 if term == "qpos" else max(1.0, np.abs(getattr(self, term)).max(initial=0.0)))

        def cost(change: np.ndarray) -> float:
            return float(engine.rollout(self.moved(term, change)))

        slopes = np.array([[(cost(h * e) - cost(-h * e)) / (2 * h) for e in basis] for h in steps])
        better = (10 * slopes[1:] - slopes[:-1]) / 9  # the ladder's factor is the root of 10, the error of order 2
        gaps = np.abs(np.diff(better, axis=0)) * steps[2:, None]
        gaps = np.maximum.accumulate(gaps[::-1])[::-1] / steps[2:, None]
        gaps[(slopes[2:] == 0) & slopes.any(axis=0)] = np.inf
        best = gaps.argmin(axis=0)[None]
        return np.take_along_axis(better[1:], best, 0)[0], float(np.take_along_axis(gaps, best, 0).max(initial=0.0))


def cases(*names: str) -> list[Case]:
    """Return the named cases, or all."""
    result = []
    for file in [FOLDER / f"{name}.json" for name in names] or sorted(FOLDER.glob("*.json")):
        data = json.loads(file.read_text())
        given = (data["qpos"], data["qvel"], data["controls"], data["parameter"]["value"])
        result.append(Case(file.stem, data, *(np.array(part, dtype=float) for part in given)))
    return result


def check(engine: Any, case: Case) -> list[dict[str, Any]]:
    """Return a row for the value and for each derivative that the engine gives of a case.

    A case in ``engine.differs``, with its reason, is compared with the engine's own differences.
    """
    row: dict[str, Any] = {"case": case.name, "term": "all", "is_right": None, "digits": None, "looks_like": ""}
    row |= {"against": "", "seconds": None, "reason": ""}
    started = time.perf_counter()
    try:
        results = {"value": engine.rollout(case), **engine.gradient(case)}
    except Exception as error:  # another engine's code may raise anything
        is_right = None if isinstance(error, NotImplementedError) else False
        return [row | {"is_right": is_right, "reason": f"{type(error).__name__}: {error}"}]
    differs = getattr(engine, "differs", {}).get(case.name, "")
    row |= {"seconds": round(time.perf_counter() - started, 4), "reason": differs}
    row["against"] = "own differences" if differs else "the set"
    return [row | {"term": term} | _verdict(engine, case, term, result, differs) for term, result in results.items()]


def _verdict(engine: Any, case: Case, term: str, result: Any, differs: str) -> dict[str, Any]:
    """Return whether a value or derivative is right, its digits of agreement, and the faults that it looks like."""
    result, faults = np.ravel(np.array(result, dtype=float)), {}
    if term == "qpos" and result.size > case.qvel.size:
        result = result @ case.tangent()
    expected, doubt = case.data["expected"][term], np.inf
    if not differs:
        doubt, faults = case.data["certainty"][term], case.data["faults"]
    elif term != "value":
        expected, doubt = case.differences(engine, term)
    if result.size != np.size(expected):
        return {"is_right": False, "seconds": None, "reason": f"{result.size} numbers instead of {np.size(expected)}"}

    def distance(numbers: Any) -> float:
        return float(np.abs(result - np.ravel(numbers)).max(initial=0.0))

    off, scale, margin = distance(expected), np.abs(expected).max(initial=1e-9), DOUBTS * doubt
    is_right = bool(off <= getattr(engine, "tolerance", 1e-6) * scale + margin)
    near = [name for name, fault in faults.items() if distance(fault.get(term, np.inf)) <= EXPLAINED * off]
    return {
        "is_right": is_right if margin <= UNCERTAIN * scale else None,
        "digits": round(float(-np.log10(max(off / scale, 1e-16))), 1) if np.isfinite(off) else None,
        "looks_like": "" if is_right else " or ".join(near),
    }


def run(engine: Any, *names: str) -> list[dict[str, Any]]:
    """Return the rows of an engine with ``rollout(case)``, a cost, and ``gradient(case)``, its derivatives by :data:`TERMS`."""
    return [row for case in cases(*names) for row in check(engine, case)]


def main(path: str, *names: str) -> None:
    """Print the rows of the class ``Engine`` of a file, and then, with its versions, as JSON in the last line."""
    sys.path.append(str(Path(path).parent))  # last: a file may have the name of a library
    engine, rows = runpy.run_path(path)["Engine"](), []
    for case in cases(*names):
        for row in check(engine, case):
            print(*row.values(), sep="\t", flush=True)
            rows.append(row)
    print(json.dumps({"versions": getattr(engine, "versions", {}), "rows": rows}))


if __name__ == "__main__":
    main(*sys.argv[1:])
