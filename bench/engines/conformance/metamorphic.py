"""Checks of a simulator on any model without a reference, with NumPy only: ``python metamorphic.py ENGINE.py MODEL.xml``.

A class ``Model`` of the engine's file is made from MJCF text. It has ``start``, the positions and velocities at the first
keyframe or the reference pose, ``acceleration(q, v, u)`` and ``step(q, v, u)``, which returns the next (q, v). Further methods,
each for the property that needs it: :data:`METHODS`. Orders and units are MuJoCo's.
"""

from __future__ import annotations

import copy
import functools
import itertools
import json
import runpy
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

CONVERGED = {"tolerance": "1e-14", "iterations": "100", "ls_iterations": "50"}
"""Options of all models: other settings of a solver have to lead to the same solution."""
HARD = ".9999 .9999 .001"
"""Impedance of equalities where a loop has to stay closed; the engine's own leaves a tenth of the acceleration without them."""
GENERATED = ("replicate", "composite", "flexcomp", "attach")
"""Elements from which an engine makes bodies of its own."""
METHODS = {
    "steps": "steps(q, v, u), rows of states in and (q, v) out",
    "rollout": "rollout(q, v, controls), the last (q, v) of steps that go on with the engine's own data",
    "gaps": "gaps(q), the gaps of all contacts and limits that act, from the geometry",
    "loops": "loops(q), the distances of equalities by component",
    "jacobian": "jacobian(q, v, u), the derivative of the next state by the state, in velocities",
    "reference": "reference(q, v, u), accelerations of another engine",
    "force": "force(q), the generalised forces at rest without constraints",
}
SPACING, LENGTH, BISECTIONS = 64, 0.02, 24
"""Points of a path along which accelerations have to be continuous, its length [rad, m], and how often its largest change is halved."""
TOUCH = 1e-6
"""Largest gap of a contact or limit at which accelerations may jump [m, rad]."""


class Subject:
    """A model in the variants of an engine, and states of a random rollout."""

    def __init__(self, make: Callable[[str], Any], path: str | Path, steps: int = 60, seed: int = 0) -> None:
        self.root, self._make = _read(Path(path)), make
        for number, joint in enumerate(_joints(self.root.find("worldbody"))):
            joint.set("name", joint.get("name", f"joint {number}"))
        for name, value in CONVERGED.items():
            _first(self.root, "option").set(name, value)
        _first(_first(self.root, "option"), "flag").set("warmstart", "disable")
        self.model, self.layout = self.variant(), _layout(self.root)
        self.random, n_u = np.random.default_rng(seed), len(self.root.findall("actuator/*"))
        q, v = (np.array(part, dtype=float) for part in self.model.start)
        v = v + 0.3 * self.random.normal(size=v.size)
        self.states = []
        for _ in range(steps):
            u = self.random.uniform(-1, 1, n_u)
            self.states.append((q, v, u))
            q, v = (np.array(part, dtype=float) for part in self.model.step(q, v, u))
            if not np.isfinite(np.append(q, v)).all():
                break

    def variant(self, change: Callable[[Any], None] = lambda root: None) -> Any:
        """Return the engine's model of the MJCF after a change."""
        root = copy.deepcopy(self.root)
        change(root)
        return self._make(ElementTree.tostring(root, encoding="unicode"))

    def moved(self, q: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return positions after a motion w ``(n_v,)``; rotations are about axes of the body."""
        result, i, j = q.copy(), 0, 0
        for _, n_q, n_v in self.layout:
            straight = n_v - 3 if n_q > n_v else n_v
            result[i : i + straight] += w[j : j + straight]
            if n_q > n_v:
                a, axis = q[i + straight : i + n_q], w[j + straight : j + n_v] / 2
                angle = np.linalg.norm(axis)
                b = np.append(np.cos(angle), axis * np.sinc(angle / np.pi))
                vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
                result[i + straight : i + n_q] = np.append(a[0] * b[0] - a[1:] @ b[1:], vector)
            i, j = i + n_q, j + n_v
        return result

    def slope(self, function: Callable[[np.ndarray], np.ndarray], q: np.ndarray, h: float = 1e-6) -> np.ndarray:
        """Return the derivative of a function of positions by motions."""
        basis = h * np.eye(self.states[0][1].size)
        return np.array([(function(self.moved(q, e)) - function(self.moved(q, -e))) / (2 * h) for e in basis]).T


def equal(change: Callable[[Any], None], other: Callable[[Any], None] = lambda root: None) -> Any:
    """Return a check of equal accelerations of two variants of a model."""

    def differences(subject: Subject) -> Iterator[tuple[int, float]]:
        models = subject.variant(other), subject.variant(change)
        for step, state in enumerate(subject.states):
            yield step, _relative(*(model.acceleration(*state) for model in models))

    return differences


def option(name: str, **values: str) -> Callable[[Any], None]:
    """Return a change of the attributes of an option's element, or of the options themselves."""

    def change(root: Any) -> None:
        element = _first(root, "option")
        (_first(element, name) if name else element).attrib.update(values)

    return change


def permuted(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of accelerations from those with bodies and geoms in reverse order."""
    if strange := [name for name in GENERATED if subject.root.find(f".//{name}") is not None]:
        raise NotImplementedError(f"the model has {', '.join(strange)}")

    def change(root: Any) -> None:
        for keyframes in root.findall("keyframe"):
            root.remove(keyframes)
        for body in [root.find("worldbody"), *root.iterfind(".//body")]:
            for tag in ("body", "geom"):
                places = [i for i, child in enumerate(body) if child.tag == tag]
                for i, child in zip(places, [body[i] for i in places[::-1]], strict=True):
                    body[i] = child
        order.extend(name for name, *_ in _layout(root))

    order: list[str] = []
    model, names = subject.variant(change), [name for name, *_ in subject.layout]
    blocks = [np.split(np.arange(part.size), np.cumsum([joint[k] for joint in subject.layout])[:-1])
              for k, part in enumerate(subject.states[0][:2], 1)]  # fmt: skip
    of_q, of_v = (np.concatenate([block[names.index(name)] for name in order]) for block in blocks)
    for step, (q, v, u) in enumerate(subject.states):
        yield step, _relative(subject.model.acceleration(q, v, u)[of_v], model.acceleration(q[of_q], v[of_v], u))


def batch(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of steps in a batch from single steps."""
    together = np.hstack(subject.model.steps(*map(np.array, zip(*subject.states, strict=True))))
    for step, state in enumerate(subject.states):
        yield step, _relative(np.concatenate(subject.model.step(*state)), together[step])


def restart(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of rollouts that start at a state from those that pass through it."""
    (q, v, _), controls = subject.states[0], np.array([state[2] for state in subject.states])
    for step in range(len(subject.states) // 2, len(subject.states), len(subject.states) // 2):
        ends = np.concatenate(subject.model.rollout(q, v, controls[:step]))
        yield step, _relative(np.concatenate(subject.states[step][:2]), ends)


def same(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of accelerations from another engine's."""
    for step, state in enumerate(subject.states):
        yield step, _relative(subject.model.reference(*state), subject.model.acceleration(*state))


def closed(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield accelerations that open closed loops, relative to those without the constraint, at closed states at speed."""
    if subject.root.find("equality") is None:
        raise NotImplementedError("the model has no equality")

    def harden(root: Any) -> None:
        for equality in root.iterfind("equality/*"):
            equality.set("solimp", HARD)

    model = subject.variant(harden)
    for step, (q, v, u) in enumerate(subject.states):
        for _ in range(20):
            q = subject.moved(q, -np.linalg.pinv(subject.slope(model.loops, q), rcond=1e-8) @ model.loops(q))
        rows = subject.slope(model.loops, q)
        v = v - np.linalg.pinv(rows, rcond=1e-6) @ (rows @ v)
        v = v * 5 / max(np.abs(v).max(), 1e-9)

        def opened(a: np.ndarray, q: np.ndarray = q, v: np.ndarray = v, t: float = 1e-4) -> float:
            ends = [model.loops(subject.moved(q, s * v + t * t / 2 * a)) for s in (t, -t)]
            return float(np.abs(ends[0] - 2 * model.loops(q) + ends[1]).max() / t**2)

        if np.abs(model.loops(q)).max() < TOUCH and opened(0 * v) > 1.0:
            yield step, opened(model.acceleration(q, v, u)) / opened(0 * v)


def continuous(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield jumps of accelerations along random paths of positions, relative to their size, where no gap is 0."""
    for step, (q, v, u) in list(enumerate(subject.states))[:: max(1, len(subject.states) // 12)]:
        way = subject.random.normal(size=v.size)

        def at(s: float, q: np.ndarray = q, v: np.ndarray = v, u: np.ndarray = u, way: np.ndarray = way) -> Any:
            return subject.model.acceleration(subject.moved(q, s * way), v, u)

        places = np.linspace(0, LENGTH, SPACING) / np.abs(way).max()
        values = [at(s) for s in places]
        for first in np.argsort([-np.abs(b - a).max() for a, b in itertools.pairwise(values)])[:4]:
            (low, high), (before, after) = places[first : first + 2], values[first : first + 2]
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                value = at(middle)
                if np.abs(value - before).max() > np.abs(value - after).max():
                    high, after = middle, value
                else:
                    low, before = middle, value
            gaps = np.concatenate([subject.model.gaps(subject.moved(q, s * way)) for s in (low, high)])
            if np.abs(gaps).min(initial=np.inf) > TOUCH:
                yield step, _relative(before, after)


def chained(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield differences of products of steps' derivatives from extrapolated differences of all these steps."""
    model, n_v = subject.model, subject.states[0][1].size
    for step in range(0, len(subject.states) - 4, max(1, len(subject.states) // 6)):
        part = subject.states[step : step + 4]
        (q, v, _), way = part[0], subject.random.normal(size=2 * n_v)
        end = way
        for state in part:
            end = model.jacobian(*state) @ end

        def after(h: float, q: np.ndarray = q, v: np.ndarray = v, part: Any = part, way: np.ndarray = way) -> Any:
            q, v = subject.moved(q, h * way[:n_v]), v + h * way[n_v:]
            for *_, u in part:
                q, v = model.step(q, v, u)
            return q, v

        slopes = []
        for h in (1e-4, 1e-5, 1e-6):
            (q1, v1), (q0, v0) = after(h), after(-h)
            slopes.append(np.append(_motion(subject.layout, q0, q1), v1 - v0) / (2 * h))
        gaps = [_relative(a, b) for a, b in itertools.pairwise(slopes)]
        if min(gaps) < 1e-5:
            yield step, _relative(slopes[1 + int(np.argmin(gaps))], end)


def symmetric(subject: Subject) -> Iterator[tuple[int, float]]:
    """Yield asymmetries of the derivative of forces at rest, which have a potential, for slides and hinges."""
    if any(n_q > 1 for _, n_q, _ in subject.layout):
        raise NotImplementedError("the model has free or ball joints")
    for step, (q, *_) in enumerate(subject.states):
        stiffness = subject.slope(subject.model.force, q)
        yield step, _relative(stiffness, stiffness.T)


PROPERTIES: dict[str, tuple[float, Any, str]] = {
    "dense = sparse": (1e-9, equal(option("", jacobian="sparse"), option("", jacobian="dense")), ""),
    "islands on = off": (1e-9, equal(option("flag", island="disable")), ""),
    "Newton = CG": (1e-4, equal(option("", solver="CG", iterations="2000"), option("", solver="Newton")), ""),
    "order of bodies and geoms": (1e-8, permuted, ""),
    "batch = single": (1e-9, batch, "steps"),
    "restart = continued": (1e-9, restart, "rollout"),
    "closed loops stay closed": (0.05, closed, "loops"),
    "accelerations are continuous": (1e-3, continuous, "gaps"),
    "steps' derivatives = rollout's": (1e-4, chained, "jacobian"),
    "forces at rest have a potential": (1e-6, symmetric, "force"),
    "accelerations = reference engine's": (1e-6, same, "reference"),
}
"""Each property's tolerance, its check, and the method that it needs."""


def check(
    make: Callable[[str], Any], path: str | Path, *names: str, steps: int = 60, seed: int = 0
) -> Iterator[dict[str, Any]]:
    """Yield a row for each named property, or all, of an engine's models made by ``make(mjcf)`` from a file.

    ``holds`` is None where a property was not checked, with the reason. ``step`` and ``state`` are of the first state that breaks
    it, ``worst`` is the largest difference in all states.
    """
    make = functools.cache(make)
    for name in names or PROPERTIES:
        tolerance, differences, method = PROPERTIES[name]
        row: dict[str, Any] = {"property": name, "holds": None, "worst": None, "tolerance": tolerance, "states": 0}
        row |= {"step": None, "state": None, "reason": ""}
        try:
            subject = Subject(make, path, steps, seed)
            if method and not getattr(subject.model, method, None):
                raise NotImplementedError(f"Model has no {METHODS[method]}")
            found = list(differences(subject))
            broken = next((step for step, off in found if not off <= tolerance), None)
            row |= {"states": len(found), "step": broken, "reason": "" if found else "no state decides it"}
            row |= {"holds": broken is None, "worst": max(off for _, off in found)} if found else {}
            row["state"] = None if broken is None else [part.tolist() for part in subject.states[broken]]
        except Exception as error:  # another engine's code may raise anything
            row |= {"holds": None if isinstance(error, NotImplementedError) else False}
            row["reason"] = f"{type(error).__name__}: {error}"
        yield row


def _relative(a: Any, b: Any) -> float:
    """Return the largest difference, relative to the largest number above 1."""
    return float(np.abs(np.subtract(a, b)).max(initial=0.0) / np.abs(a).max(initial=1.0))


def _motion(layout: list[tuple[str, int, int]], q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Return the small motion from positions to others."""
    parts, i = [], 0
    for _, n_q, n_v in layout:
        a, b = q0[i : i + n_q], q1[i : i + n_q]
        if n_q > n_v:
            (w, x), (y, z) = (a[-4], -a[-3:]), (b[-4], b[-3:])
            parts += [(b - a)[:-4], 2 * (w * z + y * x + np.cross(x, z))]
        else:
            parts.append(b - a)
        i += n_q
    return np.concatenate(parts)


def _read(path: Path) -> Any:
    """Return the root of an MJCF file with what it includes, and absolute folders of meshes and textures."""
    root = ElementTree.parse(path).getroot()
    while nodes := [(outer, node) for outer in root.iter() for node in outer if node.tag == "include"]:
        for outer, node in nodes:
            place = list(outer).index(node)
            outer[place : place + 1] = list(ElementTree.parse(path.parent / node.get("file", "")).getroot())
    compiler = _first(root, "compiler")
    for name in ("meshdir", "texturedir"):
        own = next(
            (c.get(name, c.get("assetdir")) for c in root.iterfind("compiler") if {name, "assetdir"} & set(c.keys())),
            "",
        )
        compiler.set(name, str((path.parent / (own or "")).resolve()))
    return root


def _first(root: Any, tag: str) -> Any:
    """Return an element's first child of a name, which is made if there is none."""
    found = root.find(tag)
    return ElementTree.SubElement(root, tag) if found is None else found


def _joints(body: Any) -> list[Any]:
    """Return the joints within a body, in MuJoCo's order."""
    inner = [joint for child in body if child.tag in ("body", "frame") for joint in _joints(child)]
    return [child for child in body if child.tag in ("joint", "freejoint")] + inner


def _layout(root: Any) -> list[tuple[str, int, int]]:
    """Return the name of each joint and its numbers of positions and of velocities."""
    sizes = {"free": (7, 6), "ball": (4, 3)}
    joints = _joints(root.find("worldbody"))
    kinds = [joint.get("type", "free" if joint.tag == "freejoint" else "hinge") for joint in joints]
    return [(joint.get("name"), *sizes.get(kind, (1, 1))) for joint, kind in zip(joints, kinds, strict=True)]


def main(engine: str, path: str, *words: str) -> None:
    """Print the rows of the class ``Model`` of a file as JSON, a row a line: ``[PROPERTY ...] [steps=60] [seed=0]``."""
    sys.path.append(str(Path(engine).parent))
    module = runpy.run_path(engine)
    print(json.dumps({"versions": module.get("VERSIONS", {})}))
    numbers: dict[str, Any] = {
        name: int(value) for name, _, value in (word.partition("=") for word in words if word not in PROPERTIES)
    }
    for row in check(module["Model"], path, *(word for word in words if word in PROPERTIES), **numbers):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
