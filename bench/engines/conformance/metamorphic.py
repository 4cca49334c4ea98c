"""Checks of a simulator on any model without a reference, with NumPy only: ``python metamorphic.py ENGINE.py MODEL.xml``.

A class ``Model`` of the engine's file is made from MJCF text. It has ``start``, the positions and velocities at the first
keyframe or the reference pose, ``acceleration(q, v, u)`` and ``step(q, v, u)``, which returns the next (q, v). Further methods,
each for the property that needs it: :data:`METHODS`. ``remarks``, optional, are texts on what the engine is known to do otherwise in
this model: the reason of broken properties. Orders and units are MuJoCo's.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

try:
    from . import runner
except ImportError:  # this file is the script
    import runner  # type: ignore[no-redef]

METHODS = {
    "steps": "steps(q, v, u), rows of states in and (q, v) out",
    "rollout": "rollout(q, v, controls), the last (q, v) of steps that go on with the engine's own data",
    "gaps": "gaps(q), the gaps of all contacts and limits that act, from the geometry",
    "loops": "loops(q), the distances of equalities by component",
    "jacobian": "jacobian(q, v, u), the derivative of the next state by the state, in velocities",
    "reference": "reference(q, v, u), accelerations of another engine",
    "force": "force(q), the generalised forces at rest without constraints",
}
SPACING, LENGTH, NARROWED = 64, 0.02, 8
"""Points of a path along which accelerations have to be continuous, its length [rad, m], and how often its largest change is
divided by 8."""
TOUCH = 1e-6
"""Largest gap of a contact or limit at which accelerations may jump [m, rad]."""


SETTING = r"steps=[1-9]\d*|seed=\d+"
"""What a setting of the command looks like."""


class Subject:
    """A model in the variants of an engine, and states of a random rollout."""

    def __init__(self, make: Callable[[str], Any], path: str | Path, steps: int = 60, seed: int = 0) -> None:
        self._make, self._folder = make, Path(path).resolve().parent
        self.root: Any = ElementTree.parse(path).getroot()
        root = self.root
        while nodes := [(outer, node) for outer in root.iter() for node in outer if node.tag == "include"]:
            for outer, node in nodes:
                place = list(outer).index(node)
                outer[place : place + 1] = list(ElementTree.parse(self._folder / node.get("file", "")).getroot())
        for number, joint in enumerate(_joints(root)):
            joint.set("name", joint.get("name", f"joint {number}"))
        options = _first(root, "option")
        # options of all models: other settings of a solver have to lead to the same solution
        options.attrib.update({"tolerance": "1e-14", "iterations": "100", "ls_iterations": "50"})
        _first(options, "flag").set("warmstart", "disable")
        self.model, self._layout = self.variant(), _layout(root)
        if root.find("worldbody") is None or not len(self.model.start[0]):
            raise NotImplementedError("the file has no worldbody with joints")
        self.random, n_u = np.random.default_rng(seed), len(root.findall("actuator/*"))
        q, v = (np.array(part, dtype=float) for part in self.model.start)
        v = v + 0.3 * self.random.normal(size=v.size)
        self.states = []
        for _ in range(steps):
            u = self.random.uniform(-1, 1, n_u)
            self.states.append((q, v, u))
            q, v = (np.array(part, dtype=float) for part in self.model.step(q, v, u))
            if not np.isfinite(np.append(q, v)).all():
                break

    def variant(self, path: str = "", /, **attributes: str) -> Any:
        """Return the engine's model with other attributes of the elements at a path, by default of the options."""
        root = copy.deepcopy(self.root)
        for element in root.findall(path or "option"):
            element.attrib.update(attributes)
        return self.made(root)

    def made(self, root: Any) -> Any:
        """Return the engine's model of MJCF, whose files are in the folder of the model."""
        with contextlib.chdir(self._folder):
            return self._make(ElementTree.tostring(root, encoding="unicode"))

    @property
    def layout(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The places of each joint's positions and velocities. Raises :class:`NotImplementedError` for joints of no file."""
        if sum(of_q.size for of_q, _ in self._layout.values()) != len(self.states[0][0]):
            raise NotImplementedError("the engine makes joints that the file does not name, as of replicate")
        return self._layout

    @property
    def quaternions(self) -> list[int]:
        """The places of quaternions in the positions."""
        return [int(of_q[-4]) for of_q, of_v in self.layout.values() if of_q.size > of_v.size]

    def moved(self, q: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return positions after a motion w ``(n_v,)``; rotations are about axes of the body."""
        return runner.moved(q, self.quaternions, w)

    def slope(self, function: Callable[[np.ndarray], np.ndarray], q: np.ndarray, h: float = 1e-6) -> np.ndarray:
        """Return the derivative of a function of positions by motions."""
        basis = h * np.eye(self.states[0][1].size)
        return np.array([(function(self.moved(q, e)) - function(self.moved(q, -e))) / (2 * h) for e in basis]).T


Results = Callable[[Subject], Any]
"""A function that returns an array for each state."""


def equal(one: Results, other: Results) -> Any:
    """Return a check of equal results."""
    return lambda subject: enumerate(map(_relative, one(subject), other(subject)))


def accelerations(path: str = "", /, **attributes: str) -> Results:
    """Return accelerations of the model with other attributes of the elements at a path."""

    def results(subject: Subject) -> list[Any]:
        model = subject.variant(path, **attributes)
        return [model.acceleration(*state) for state in subject.states]

    return results


def permuted(subject: Subject) -> Iterator[Any]:
    """Yield accelerations of the model with bodies and geoms in reverse order."""
    root: Any = copy.deepcopy(subject.root)
    places = subject.layout
    for keyframes in root.findall("keyframe"):
        root.remove(keyframes)
    for body, tag in itertools.product([*root.iterfind("worldbody"), *root.iterfind(".//body")], ("body", "geom")):
        alike = [i for i, child in enumerate(body) if child.tag == tag]
        for i, child in zip(alike, [body[i] for i in alike[::-1]], strict=True):
            body[i] = child
    model, parts = subject.made(root), [places[name] for name in _layout(root)]
    of_q, of_v = map(np.concatenate, zip(*parts, strict=True))
    for q, v, u in subject.states:
        yield np.array(model.acceleration(q[of_q], v[of_v], u))[np.argsort(of_v)]


def restart(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of a state of the rollout from the end of a rollout to it."""
    step, controls = len(subject.states) // 2, [u for *_, u in subject.states]
    ends = subject.model.rollout(*subject.states[0][:2], np.array(controls[:step]))
    yield step, _relative(np.concatenate(subject.states[step][:2]), np.concatenate(ends))


def closed(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield accelerations that open closed loops, relative to those without the constraint, at closed states at speed."""
    if subject.root.find("equality") is None:
        raise NotImplementedError("the model has no equality")
    # impedance of equalities where a loop has to stay closed; the engine's own leaves a tenth of the
    # acceleration without them
    model = subject.variant("equality/*", solimp=".9999 .9999 .001")

    def opened(q: np.ndarray, v: np.ndarray, a: Any, t: float = 1e-4) -> float:
        ends = [model.loops(subject.moved(q, s * v + t * t / 2 * a)) for s in (t, -t)]
        return float(np.abs(ends[0] - 2 * model.loops(q) + ends[1]).max() / t**2)

    for step, (q, v, u) in enumerate(subject.states):
        for _ in range(20):
            rows = subject.slope(model.loops, q)
            q = subject.moved(q, -np.linalg.pinv(rows, rcond=1e-8) @ model.loops(q))
        v = v - np.linalg.pinv(rows, rcond=1e-6) @ (rows @ v)
        v = v * 5 / max(np.abs(v).max(), 1e-9)
        if np.abs(model.loops(q)).max() < TOUCH and (free := opened(q, v, 0 * v)) > 1.0:
            yield step, opened(q, v, model.acceleration(q, v, u)) / free


def continuous(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield jumps of accelerations along random paths of positions, relative to their size, where no gap is 0."""
    for step, state in list(enumerate(subject.states))[:: max(1, len(subject.states) // 12)]:
        for jump in _jumps(subject, *state):
            yield step, jump


def _jumps(subject: Subject, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> Iterator[float]:
    way = subject.random.normal(size=v.size)

    def at(s: float) -> np.ndarray:
        return subject.moved(q, s * way / np.abs(way).max())

    def changes(places: np.ndarray) -> np.ndarray:
        values = [subject.model.acceleration(at(s), v, u) for s in places]
        return np.array([np.abs(np.subtract(b, a)).max() for a, b in itertools.pairwise(values)])

    places = np.linspace(0, LENGTH, SPACING)
    for first in np.argsort(-changes(places))[:4]:
        ends = places[first : first + 2]
        for _ in range(NARROWED):
            inner = np.linspace(ends[0], ends[1], 9)
            first = changes(inner).argmax()
            ends = inner[first : first + 2]
        if np.abs(np.concatenate([subject.model.gaps(at(s)) for s in ends])).min(initial=np.inf) > TOUCH:
            yield _relative(*(subject.model.acceleration(at(s), v, u) for s in ends))


def chained(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of products of steps' derivatives from extrapolated differences of all these steps."""
    for step in range(0, len(subject.states) - 4, max(1, len(subject.states) // 6)):
        part, (last, *_) = subject.states[step : step + 4], subject.states[step + 4]
        way = subject.random.normal(size=2 * part[0][1].size)

        def after(change: np.ndarray, part: Any = part) -> np.ndarray:
            (q, v, _), (w, dv) = part[0], np.split(change, 2)
            at = subject.moved(q, w), v + dv
            for *_, u in part:
                at = subject.model.step(*at, u)
            return np.concatenate(at)

        (slope,), (doubt,) = runner.differences(after, [way])
        # largest uncertainty of differences of steps, relative to the largest of them, at which derivatives are
        # compared with them
        if doubt.max() <= 1e-5 * np.abs(slope).max():
            w, dv = np.split(functools.reduce(lambda end, at: subject.model.jacobian(*at) @ end, part, way), 2)
            yield step, _relative(slope, np.append(runner.tangent(last, subject.quaternions) @ w, dv))


def symmetric(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield asymmetries of the derivative of forces at rest, which have a potential, for slides and hinges."""
    if subject.quaternions:
        raise NotImplementedError("the model has free or ball joints")
    for step, (q, *_) in enumerate(subject.states):
        stiffness = subject.slope(subject.model.force, q)
        yield step, _relative(stiffness, stiffness.T)


PROPERTIES: dict[str, tuple[float, Any, str]] = {
    "dense = sparse": (1e-9, equal(accelerations(jacobian="dense"), accelerations(jacobian="sparse")), ""),
    "islands on = off": (1e-9, equal(accelerations(), accelerations("option/flag", island="disable")), ""),
    "Newton = CG": (1e-4, equal(accelerations(solver="Newton"), accelerations(solver="CG", iterations="2000")), ""),
    "order of bodies and geoms": (1e-8, equal(accelerations(), permuted), ""),
    "batch = single": (
        1e-9,
        equal(
            lambda subject: (np.concatenate(subject.model.step(*state)) for state in subject.states),
            lambda subject: np.hstack(subject.model.steps(*map(np.array, zip(*subject.states, strict=True)))),
        ),
        "steps",
    ),
    "restart = continued": (1e-9, restart, "rollout"),
    "closed loops stay closed": (0.05, closed, "loops"),
    "accelerations are continuous": (1e-3, continuous, "gaps"),
    "steps' derivatives = rollout's": (1e-4, chained, "jacobian"),
    "forces at rest have a potential": (1e-6, symmetric, "force"),
    "accelerations = reference engine's": (
        1e-6,
        equal(lambda subject: (subject.model.reference(*state) for state in subject.states), accelerations()),
        "reference",
    ),
}
"""Each property's tolerance, its check, and the method that it needs."""


def check(
    make: Callable[[str], Any], path: str | Path, *names: str, steps: int = 60, seed: int = 0
) -> Iterator[dict[str, Any]]:
    """Yield a row for each named property, or all, of an engine's models made by ``make(mjcf)`` from a file.

    ``holds`` is None where a property was not checked, with the reason. ``step`` and ``state`` are of the first state that breaks
    it, ``worst`` is the largest difference in all states; then the reason has the model's remarks.
    """
    subject = Subject(functools.cache(make), path, steps, seed)
    for name in names or PROPERTIES:
        tolerance, differences, method = PROPERTIES[name]
        row: dict[str, Any] = {"property": name, "holds": None, "worst": None, "tolerance": tolerance, "states": 0}
        row |= {"step": None, "state": None, "reason": ""}
        subject.random = np.random.default_rng([seed, 1])
        try:
            if method and not getattr(subject.model, method, None):
                raise NotImplementedError(f"Model has no {METHODS[method]}")
            found = list(differences(subject))
            broken = next((step for step, off in found if not off <= tolerance), None)
            row |= {"states": len(found), "step": broken, "reason": "" if found else "no state decides it"}
            row |= {"holds": broken is None, "worst": max(off for _, off in found)} if found else {}
            if broken is not None:
                row["state"] = [part.tolist() for part in subject.states[broken]]
                row["reason"] = "; ".join(getattr(subject.model, "remarks", ()))
        except Exception as error:  # another engine's code may raise anything
            row |= {"holds": None if isinstance(error, NotImplementedError) else False}
            row["reason"] = f"{type(error).__name__}: {error}"
        yield row


def _relative(a: Any, b: Any) -> float:
    """Return the largest difference, relative to the largest number above 1."""
    return float(np.abs(np.subtract(a, b)).max(initial=0.0) / np.abs(a).max(initial=1.0))


def _first(root: Any, tag: str) -> Any:
    """Return an element's first child of a name, which is made if there is none."""
    found = root.find(tag)
    return ElementTree.SubElement(root, tag) if found is None else found


def _joints(body: Any) -> list[Any]:
    """Return the joints within a body, in MuJoCo's order."""
    inner = [joint for child in body if child.tag in ("worldbody", "body", "frame") for joint in _joints(child)]
    return [child for child in body if child.tag in ("joint", "freejoint")] + inner


def _layout(root: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the places of each joint's positions and velocities, by name."""
    result, i, j = {}, 0, 0
    for joint in _joints(root):
        kind = joint.get("type", "free" if joint.tag == "freejoint" else "hinge")
        n_q, n_v = {"free": (7, 6), "ball": (4, 3)}.get(kind, (1, 1))
        result[joint.get("name")] = np.arange(i, i + n_q), np.arange(j, j + n_v)
        i, j = i + n_q, j + n_v
    return result


def main(engine: str, path: str, *words: str) -> None:
    """Print the rows of the class ``Model`` of a file as JSON, a row a line: ``[PROPERTY ...] [steps=60] [seed=0]``."""
    names, settings = ([word for word in words if (word in PROPERTIES) == is_name] for is_name in (True, False))
    if strange := [word for word in settings if not re.fullmatch(SETTING, word)]:
        sys.exit(f"{strange[0]!r} is not a property or a setting; properties: {', '.join(PROPERTIES)}")
    module = runner.load(engine, "Model")
    numbers: dict[str, Any] = {name: int(value) for name, _, value in (word.partition("=") for word in settings)}
    rows = runner.printed(module.get("VERSIONS", {}), check(module["Model"], path, *names, **numbers))
    found = {row["holds"] for row in rows}
    sys.exit(runner.WRONG * (False in found or True not in found))


if __name__ == "__main__":
    main(*sys.argv[1:]) if sys.argv[2:] else sys.exit(__doc__)
