"""Effects that a model lacks, and how each would change its record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .model import Model
from .record import evaluate

TERMS = {
    "start": {"start": "1"},
    "acceleration": {
        "constant force": "1",
        "drag v|v|": "v*abs(v)",
        "drag v^3": "v**3",
        "dry friction": "sign(v)",
        "spring q^2": "q**2",
        "spring q^3": "q**3",
        "hysteresis": "hysteresis(q)",
    },
    "control": {"lag": "slope(x)", "dead zone": "sign(x)"},
    "sensor": {"offset": "1", "gain": "x", "drift": "t", "delay": "slope(x)"},
}
"""Effects that a model may lack by where they act, as expressions along the motion.

x is what they act on, q and v are the coordinate that they accelerate, q0, v0, ... the state, and t rises from -1 to 1.
"""


@dataclass(frozen=True, eq=False)
class _Place:
    """Where an effect may act: a kind of :data:`TERMS`, what it acts on, the course of that, and the largest size."""

    kind: str
    of: str
    signal: np.ndarray
    size: float


Effects = dict[str, tuple[_Place, np.ndarray]]
"""Effects by name: the place of each, and its course along the motion."""


def _places(model: Model, path: np.ndarray, controls: np.ndarray) -> list[_Place]:
    """Return the places along a motion: entries of the start, accelerations, controls and sensors."""
    scene, entries = model.program.scene, model.entries
    speeds, inputs = path[:, scene.n_q :], np.pad(controls, ((0, 1), (0, 0)), "edge")
    acceleration = np.abs(np.diff(speeds, axis=0)).max() / scene.dt

    def place(kind: str, of: str, signal: np.ndarray) -> _Place:
        return _Place(kind, of, signal, np.abs(signal).max())

    return [
        *(place("start", entry, signal) for entry, signal in zip(entries, path.T, strict=True)),
        *(_Place("acceleration", f"q{i}", signal, acceleration) for i, signal in enumerate(speeds.T)),
        *(place("control", f"u{i}", signal) for i, signal in enumerate(inputs.T)),
        *(place("sensor", f"sensor {entries[i]}", path[:, i]) for i in model.measured),
    ]


def _effects(place: _Place, state: Mapping[str, np.ndarray], own: Mapping[str, str]) -> Effects:
    """Return the effects that may act in a place along the course of a state; ``own`` are further accelerations."""
    known = {**state, "t": np.linspace(-1.0, 1.0, len(place.signal)), "x": place.signal}
    texts = TERMS[place.kind]
    if place.kind == "acceleration":
        axis = place.of[1:]
        texts = texts | {f"coupling with {entry}": entry for entry in state if entry[1:] != axis} | dict(own)
        known |= {"q": state[place.of], "v": state[f"v{axis}"]}
    return {f"{name} of {place.of}": (place, evaluate(text, known)) for name, text in texts.items()}


def missing_terms(
    model: Model, theta: np.ndarray, sigma: float, own: Mapping[str, str] | None = None
) -> dict[str, np.ndarray]:
    """Return the change of the standardised record ``(m,)`` per unit of effects that the model lacks, by name.

    The effects are :data:`TERMS`, accelerations in other coordinates, and the accelerations ``own``. They act along the
    motion of ``theta (p,)``, to first order. A scene whose velocities are not those of its positions has no accelerations.
    """
    path, controls = (part[:, :, 0] for part in model.motion(theta[:, None]))
    state, scene = dict(zip(model.entries, path.T, strict=True)), model.program.scene
    places = _places(model, path, controls)
    effects: Effects = {}
    for place in places:
        if place.kind != "acceleration" or scene.n_q == scene.n_v:
            effects |= _effects(place, state, own or {})
    changes = _changes(model, theta, sigma, places, effects)
    free = {name.replace(".", " of ") for name in model.names}
    return {
        name: change
        for name, change in zip(effects, changes, strict=True)
        if name not in free and np.isfinite(change).all() and change.any()
    }


def _changes(model: Model, theta: np.ndarray, sigma: float, places: list[_Place], effects: Effects) -> np.ndarray:
    """Return the change of the standardised record per unit of each effect, ``(effects, m)``, by central differences."""
    # half the distance of the two records, relative to the size of what an effect acts on
    step = 1e-4
    courses = np.zeros((len(places[0].signal), len(places), len(effects)))
    for column, (place, course) in enumerate(effects.values()):
        courses[:, places.index(place), column] = step * place.size * course / (np.abs(course).max() or 1.0)
    both, kinds = np.concatenate([courses, -courses], axis=2), np.array([place.kind for place in places])
    starts, pushes, nudges, sensors = (both[:, kinds == kind] for kind in TERMS)
    wide = np.repeat(theta[:, None], both.shape[2], axis=1)
    record = model.record(wide, lambda s, *_: pushes[s], lambda s: nudges[s], starts[0])
    seen = record + sensors[np.array(model.steps)].reshape(record.shape)
    up, down = np.split(seen.T / (2.0 * step * sigma), 2)
    return up - down
