"""Runs the conformance set on an engine, with NumPy only: ``python runner.py ENGINE.py [CASE ...]`` prints its rows as JSON."""

from __future__ import annotations

import json
import runpy
import sys
import time
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
"""Largest such margin, relative to the derivative, at which it is judged."""
EXPLAINED = 0.1
"""Largest distance to a fault's numbers, as a share of the distance to the right ones, at which an engine has the fault."""


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
        result = np.delete(np.eye(self.qpos.size), self.data["quaternions"], axis=1)
        for before, i in enumerate(self.data["quaternions"]):
            w, x, y, z = self.qpos[i : i + 4] / 2
            result[i : i + 4, i - before : i - before + 3] = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
        return result

    def moved(self, term: str, change: np.ndarray) -> Case:
        """Return the case with another start, controls or parameter; ``change`` is flat, and of velocities for qpos."""
        old = getattr(self, term)
        new = old + (self.tangent() @ change if term == "qpos" else change.reshape(old.shape))
        for i in self.data["quaternions"] if term == "qpos" else ():
            new[i : i + 4] /= np.linalg.norm(new[i : i + 4])
        return replace(self, **{term: new})

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
        given = (*(data[term] for term in TERMS[:3]), data["parameter"]["value"])
        inputs = (np.array(values, dtype=float) for values in given)
        result.append(Case(file.stem, file.with_suffix(".xml"), data, *inputs))
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
        seconds, differs = time.perf_counter() - started, getattr(engine, "differs", {}).get(case.name, "")
        row |= {"against": "own differences" if differs else "the set", "seconds": round(seconds, 4), "reason": differs}
        return [row | {"term": term} | _verdict(engine, case, term, found, differs) for term, found in results.items()]
    except Exception as error:  # another engine's code may raise anything
        is_right = None if isinstance(error, NotImplementedError) else False
        return [row | {"is_right": is_right, "reason": f"{type(error).__name__}: {error}"}]


def _verdict(engine: Any, case: Case, term: str, found: Any, differs: str) -> dict[str, Any]:
    """Return whether a value or derivative is right, its digits of agreement, and the faults that it looks like."""
    result = np.ravel(np.array(found, dtype=float))
    if term == "qpos" and result.size > case.qvel.size:
        result = result @ case.tangent()
    expected, doubt, faults = (case.data[name] for name in ("expected", "certainty", "faults"))
    expected, doubt = np.ravel(expected[term]), doubt[term]
    if differs:
        expected, doubt = (expected, np.inf) if term == "value" else case.differences(engine, term)
        faults = {}
    if result.size != expected.size:
        return {"is_right": False, "reason": f"{result.size} numbers instead of {expected.size}"}
    off, scale, margin = np.abs(result - expected).max(), np.abs(expected).max(initial=1e-9), DOUBTS * doubt
    is_right = off <= getattr(engine, "tolerance", 1e-6) * scale + margin
    near = [name for name, by in faults.items() if np.abs(result - by.get(term, np.inf)).max() <= EXPLAINED * off]
    return {
        "is_right": bool(is_right) if margin <= UNCERTAIN * scale else None,
        "digits": round(float(-np.log10(max(off / scale, 1e-16))), 1) if np.isfinite(off) else None,
        "looks_like": "" if is_right else " or ".join(near),
    }


def run(engine: Any, *names: str) -> list[dict[str, Any]]:
    """Return the rows of an engine with ``rollout(case)``, a cost, and ``gradient(case)``, its derivatives by :data:`TERMS`."""
    return [row for case in cases(*names) for row in check(engine, case)]


def main(path: str, *names: str) -> None:
    """Print the versions and the rows of the class ``Engine`` of a file as JSON, each on a line as soon as it is known."""
    sys.path.append(str(Path(path).parent))  # last: a file may have the name of a library
    engine = runpy.run_path(path)["Engine"]()
    print(json.dumps({"versions": getattr(engine, "versions", {})}))
    for case in cases(*names):
        for row in check(engine, case):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
