"""The events that a problem's scene declares, for estimators that need to know where the cost jumps."""

from __future__ import annotations

import numpy as np

from bench.model.problem import Problem
from bench.model.program import Program
from bench.model.scene import Events, EventScene


def events_of(problem: Problem, theta: np.ndarray, w: np.ndarray) -> Events:
    """Return the events that the problem's scene declares, none without the role.

    A problem may scale its scene's noise. The event ``directions . (c w) < limits`` has limits and slopes over c.
    """
    scene = problem.program.scene
    if not isinstance(scene, EventScene):
        return Events(np.empty((0, len(w))), np.empty((0, w.shape[1])), np.empty((0, problem.dim, w.shape[1])))
    scale = problem.sigma / scene.sigma
    directions, limits, slopes = scene.events(np.asarray(theta), scale * w)
    return Events(directions, limits / scale, slopes / scale)


def undeclared_jumps(program: Program) -> str | None:
    """Return why the declared events are not all places where the cost may jump, or None if they are."""
    name = program.scene.name
    if program.surrogate:
        return f"the gradient of contact law {program.contact.name if program.contact else ''} is a surrogate"
    if program.contact is not None and not program.contact.continuous:
        return f"contact law {program.contact.name} may jump, and declares no events"
    if isinstance(program.scene, EventScene):
        return f"the events of {name} are declared for its own theta" if program.decision.names else None
    return None if program.continuous else f"the cost of {name} jumps, and the scene declares no events (EventScene)"
