"""Compares the program's gradient with differences of its cost, at theta0 and on both sides of a contact switch."""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from bench import gradient as gradcheck
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.measure.batches import in_columns
from bench.measure.contacts import active_contacts, contact_names, engine_contacts
from bench.measure.jumps import Jump, Sampled, jump_under_noise, missed_slope, sampled_gradients
from bench.model import SURROGATE, ContactScene, EngineScene, ForceLaw, LoopOps, Problem, Rollout, Unsupported, registry

from .. import SPREAD, norm, spectral_radius
from . import GradientCheck, is_trusted

COLUMNS_AT_ONCE = 128
"""Rollouts per evaluation. The number is fixed, so that a compiling backend compiles once."""


@dataclass(frozen=True)
class Place:
    """Where one directional derivative is checked: ``theta (d,)``, unit ``direction (d,)``, noise ``w (n_w,)``, and labels."""

    point: str
    """One of :data:`bench.plugins.studies.gradient_check.POINTS`."""
    number: int
    """Number of the direction, or -1 - i for component i."""
    noise: int
    """0 without noise, 1 with it."""
    theta: np.ndarray
    direction: np.ndarray
    w: np.ndarray
    switch: str = ""
    """The contact switch that the place is at, in words."""
    verdict: str = ""
    """The verdict on what noise reaches here, known before the check."""


@dataclass(frozen=True)
class Point:
    """One checked directional derivative and its verdict."""

    place: Place
    verdict: str
    sample: gradcheck.Sample
    minus: Sequence[str]
    """Contact modes on the minus side, one per step of the differences."""
    plus: Sequence[str]
    """Contact modes on the plus side."""

    @property
    def error(self) -> float:
        """Smallest relative error over all steps."""
        return float(self.sample.errors[gradcheck.best(self.sample)])

    @property
    def eps(self) -> float:
        """Step of the smallest error, in units of the scale of theta."""
        return float(gradcheck.EPS[gradcheck.best(self.sample)])


def measure(cell: Cell, session: Session, search: GradientCheck) -> dict[str, Any]:
    """Return one cell's results by column, except ``command``, from checks at theta0 and around contact switches."""
    problem = session.problem(cell)
    theta, unit = problem.program.theta0, float(np.finfo(cell.backend.dtype).eps)
    drawn = noise.draw(cell.seed, cell.scene.name, 1, 1, problem.program.n_noise, "gradient check")[0, 0]
    directions = noise.draw(cell.seed, cell.scene.name, 1, search.drawn, theta.size, "directions")[0]
    whole = start(problem, theta, unit, search, cell.seed)
    sampled = sampled_gradients(problem, theta, cell.seed, COLUMNS_AT_ONCE)
    (jump, distance), events = under_noise(problem, theta, sampled, cell.seed)
    along = directions[0] / np.linalg.norm(directions[0])
    reached = [Place("noise", 0, 1, theta, along, event.w, verdict=event.verdict) for event in events]
    found = examine(problem, drawn, directions, unit, search, reached)
    points = [*at_start(whole), *(_settled(problem, point) for point in found)]
    is_lost = all(point.verdict == "nonfinite" for point in points)
    remarks = [SURROGATE] if problem.program.surrogate else []
    remarks += [] if whole.cause in PLAIN else [whole.sentence()]
    remarks += [*(event.remark for event in events), *beyond_stability(cell)]
    return {
        "status": "nonfinite" if is_lost else "ok",
        "reason": "no cost is finite" if is_lost else "; ".join(remarks),
        **verdict_columns(points, sampled.spread / math.sqrt(cell.samples)),
        "scale": scale_of(theta),
        "taylor_order": whole.order,
        "jump": jump.height,
        "jump_share": jump.height / jump.span if jump.height else 0.0,
        "jump_distance": distance,
        "cost_noise": whole.noise,
        "device": problem.device,
        **component_columns(whole.components),
        **check_columns(points),
    }


def verdict_columns(points: Sequence[Point], spread: float) -> dict[str, Any]:
    """Return the columns of the worst check, and whether the gradient can be trusted where estimates have a ``spread``."""
    worst = min(points, key=lambda point: (gradcheck.VERDICTS.index(point.verdict), -point.error))
    untrusted = sum(not is_trusted(point.place.point, point.verdict) for point in points)
    return {
        "verdict": worst.verdict,
        "best_error": worst.error,
        "best_eps": worst.eps,
        "untrusted": untrusted,
        "spread": spread,
        "trusted": "no" if untrusted or not spread < SPREAD else "yes",
    }


def component_columns(parts: Sequence[gradcheck.Part]) -> dict[str, list[Any]]:
    """Return the columns with a value per checked component."""
    columns = {f"component_{name}": [getattr(part, name) for part in parts] for name in PER_COMPONENT}
    return {"component": [part.component for part in parts], **columns}


def check_columns(points: Sequence[Point]) -> dict[str, list[Any]]:
    """Return the columns with a value per check, or per check and step of the differences."""
    return {
        **{name: [attrgetter(path)(point) for point in points] for name, path in PER_CHECK.items()},
        "eps": gradcheck.EPS.tolist(),
        "derivative_differences": np.concatenate([point.sample.differences for point in points]).tolist(),
        "relative_error": np.concatenate([point.sample.errors for point in points]).tolist(),
        "mode_minus": [mode for point in points for mode in point.minus],
        "mode_plus": [mode for point in points for mode in point.plus],
    }


class Event(NamedTuple):
    """What noise ``w (n_w,)`` reaches: its verdict, and a remark."""

    verdict: str
    w: np.ndarray
    remark: str


def under_noise(
    problem: Problem, theta: np.ndarray, sampled: Sampled, seed: int
) -> tuple[tuple[Jump, float], list[Event]]:
    """Return the largest jump that noise reaches at ``theta (d,)`` and its distance, and all that it reaches.

    A jump is a fault of its own, and the slope that it carries is no other one.
    """
    events = []
    names = {"nan_gradient": "gradients of finite costs", "nonfinite": "costs"}
    for (verdict, name), lost in zip(names.items(), sampled[:2], strict=True):
        if lost.share:
            remark = f"{lost.share:.2g} of all {name} under noise are not numbers, from {norm(lost.w):.2g} standard deviations on"
            events.append(Event(verdict, lost.w, remark))
    jump, at = jump_under_noise(problem, theta, seed, COLUMNS_AT_ONCE)
    if jump.height:
        remark = (
            f"the cost jumps by {jump.height:.3g}, {jump.height / jump.span:.2g} of its range, under noise of "
            f"{norm(at):.2g} standard deviations: the mean of gradients misses jumps"
        )
        return (jump, norm(at)), [*events, Event("jump", at, remark)]
    missed = missed_slope(problem, theta, seed, COLUMNS_AT_ONCE)
    if missed.share:
        remark = (
            f"sampled gradients miss {missed.share:.2g} of the mean slope along a line through the noise, most of it near "
            f"{norm(missed.w):.2g} standard deviations: a steep rise, or a far kink"
        )
        events.append(Event("missed_slope", missed.w, remark))
    return (jump, math.nan), events


PER_CHECK = {
    "point": "place.point",
    "sample": "place.noise",
    "direction": "place.number",
    "contact_switch": "place.switch",
    "derivative_program": "sample.derivative",
    "check_verdict": "verdict",
    "check_error": "error",
    "check_eps": "eps",
}
"""What is stored of each check, by column: an attribute of its :class:`Point`."""
PER_COMPONENT = ("program", "difference", "uncertainty", "step", "ratio", "left", "right", "verdict")
"""What is stored of each checked component."""
PLAIN = ("smooth", "nonlinear", "zero", "mode_crossing")
"""Verdicts on theta0 that need no remark."""


def start(problem: Problem, theta: np.ndarray, unit: float, search: GradientCheck, seed: int) -> gradcheck.Check:
    """Check every component and random directions at ``theta (d,)`` and at other thetas near it, without noise.

    ``unit`` is the unit roundoff of the program's arithmetic. Costs are evaluated in batches of a fixed width, so that
    a compiling backend compiles once. A gradient is the last column of a batch whose first column is theta, because a
    faulty backend may be right for a single column only.
    """
    still = np.zeros((problem.program.n_noise, COLUMNS_AT_ONCE))

    def cost(thetas: np.ndarray) -> np.ndarray:
        return in_columns(lambda part: problem.value(part, still), thetas, COLUMNS_AT_ONCE)

    def gradient(at: np.ndarray) -> np.ndarray:
        return problem.grad(np.stack([theta, at], axis=1), still[:, :2])[:, -1]

    modes = contact_modes(problem)
    named = None if modes is None else lambda thetas: modes(thetas, np.zeros((len(still), thetas.shape[1])))
    options = gradcheck.Options(
        directions=search.directions, draws=search.around, unit=unit, seed=seed, step=problem.step
    )
    return gradcheck.check(
        cost, gradient, theta, options, named, lambda at, along: tangent(problem, at, along, still[:, 0])
    )


def tangent(problem: Problem, theta: np.ndarray, direction: np.ndarray, w: np.ndarray) -> float:
    """Return the derivative at ``theta (d,)`` along ``direction (d,)`` under noise ``w (n_w,)`` by the backend's second method, else a complex step.

    It is NaN where neither is possible.
    """
    if problem.program.surrogate:
        return math.nan
    try:
        return float(problem.second_gradient(theta, w[:, None])[:, 0] @ direction)
    except Exception:  # unsupported, or a program that the second method cannot differentiate
        return complex_step(problem, theta, direction, w)


def complex_step(problem: Problem, theta: np.ndarray, direction: np.ndarray, w: np.ndarray) -> float:
    """Return the derivative of the program at ``theta (d,)`` along ``direction (d,)`` by a complex step; NaN if invalid.

    The imaginary part of the cost at theta + i h direction is h times the derivative, without cancellation (Squire and
    Trapp 1998). It needs code that is analytic, so it is NaN for programs with contacts or equations to solve, or where
    the real part is not the cost.
    """
    program = problem.program
    if program.contact is not None or program.needs or program.surrogate or "physics" in problem.provides:
        return math.nan
    # largest imaginary part of theta in a complex step; its square underflows beside every cost
    size = 1e-100 / max(float(np.abs(direction).max()), 1e-300)
    try:
        with np.errstate(all="ignore"):
            value = program.cost(
                LoopOps(), theta[:, None] + 1j * size * direction[:, None], w[:, None].astype(complex)
            )[0]
            real = problem.value(theta, w)
    except Exception:  # code of a plugin that does not run on complex numbers
        return math.nan
    # relative difference between the costs of two array libraries: a chaotic rollout amplifies their rounding
    if not abs(complex(value).real - real) <= 1e-3 * abs(real):
        return math.nan
    return float(complex(value).imag / size)


def at_start(whole: gradcheck.Check) -> list[Point]:
    """Return the points at theta0: all components, and untrusted directions and thetas whose verdicts no component has."""
    parts = list(whole.components)
    seen = {part.verdict for part in parts}
    parts += [
        part for part in whole.parts if part.component is None and part.verdict not in (*gradcheck.TRUSTED, *seen)
    ]
    if whole.cause not in (*seen, *(part.verdict for part in parts)):
        # the cause occurs only at other thetas, or in a second evaluation
        parts += [replace(part, verdict=whole.cause) for part in (*whole.worst_parts, *whole.parts)[:1]]
    none = np.empty(0)
    places = [Place("start", _number(part), 0, none, none, none) for part in parts]
    return [Point(at, part.verdict, part.sample, *part.modes) for at, part in zip(places, parts, strict=True)]


def _number(part: gradcheck.Part) -> int:
    return -1 - part.component if part.component is not None else int(part.name.rpartition(" ")[2])


def _settled(problem: Problem, point: Point) -> Point:
    """Return the point with its verdict under noise, or from smaller steps or a tangent if the usual steps leave it unsettled."""
    place = point.place
    if place.verdict:
        return replace(point, verdict=place.verdict)
    if point.verdict != "unsettled":
        return point
    scale, d = scale_of(problem.program.theta0), place.theta.size
    finding = gradcheck.settle(
        _cost(problem, d),
        np.r_[place.theta, place.w],
        np.r_[scale * place.direction, 0.0 * place.w],
        scale,
        point.sample,
        lambda at, vector: tangent(problem, at[:d], vector[:d], at[d:]),
    )
    return point if finding is None else replace(point, verdict=finding.verdict)


def _cost(problem: Problem, d: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the cost of columns of theta and noise, ``(d + n_w, B)`` to ``(B,)``, in batches of a fixed width."""
    return lambda at: in_columns(lambda part: problem.value(part[:d], part[d:]), at, COLUMNS_AT_ONCE)


def beyond_stability(cell: Cell) -> list[str]:
    """Return a remark if the integrator is unstable on the contact law's spring at this dt, else an empty list."""
    scene, law, integrator = cell.scene, cell.contact, cell.integrator
    spring = law.spring() if isinstance(law, ForceLaw) else None
    if not isinstance(scene, ContactScene) or spring is None or integrator is None:
        return []
    first = scene.initial_state(np, scene.theta0()[:, None])
    response = float(scene.contact(np).response(np, first.q).max())
    factor = float(getattr(scene, "velocity_factor", 1.0))
    growth = spectral_radius(integrator, float(scene.dt), spring[0] * response, spring[1] * response, factor)
    # relative growth of the state per step up to which rounding may be the cause
    if growth <= 1.0 + 1e-9:
        return []
    return [
        f"the step is beyond the stability limit of the contact: each step in contact multiplies the state by up to "
        f"{growth:.3g}; take a smaller dt"
    ]


def scale_of(theta: np.ndarray) -> float:
    """Return the natural scale of displacements of theta: its norm, but at least 1."""
    return max(1.0, norm(theta))


# ----------------------------------------------------------------------------------------------------- checks


def examine(
    problem: Problem,
    drawn: np.ndarray,
    directions: np.ndarray,
    unit: float,
    search: GradientCheck,
    more: Sequence[Place] = (),
) -> list[Point]:
    """Check directional derivatives at theta0, without noise and with ``drawn (n_w,)``, and at contact switches.

    Derivatives at theta0 are along the first ``search.directions`` of ``directions (D, d)``. Switches are searched along
    all directions, without noise, and checked along the first ``search.directions`` that meet one. ``more`` places are
    checked too. ``unit`` is the unit roundoff of the program's arithmetic. All costs are evaluated twice.
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    modes, theta = contact_modes(problem), problem.program.theta0
    still = np.zeros_like(drawn)
    places = [
        Place("start", number, sample, theta, direction, w)
        for sample, w in enumerate((still, drawn))
        for number, direction in enumerate(directions[: search.directions])
    ]
    if modes is not None:
        met = (boundary(modes, theta, direction, still, number, search) for number, direction in enumerate(directions))
        places += itertools.chain(*itertools.islice(filter(None, met), search.directions))
    places += more
    d, scale = theta.size, scale_of(theta)
    thetas, along, noises = (
        np.stack([getattr(p, name) for p in places], axis=1) for name in ("theta", "direction", "w")
    )
    slopes = [direction @ gradient for direction, gradient in zip(along.T, problem.grad(thetas, noises).T, strict=True)]
    samples, minus, plus = gradcheck.sampled(
        _cost(problem, d),
        gradcheck.Lines(
            np.concatenate([thetas, noises]),
            np.concatenate([scale * along, 0.0 * noises]),
            np.array(slopes),
            scale,
        ),
        unit,
        modes=None if modes is None else lambda at: modes(at[:d], at[d:]),
        twice=True,
    )
    parts = zip(places, samples, minus, plus, strict=True)
    return [Point(place, gradcheck.judge(sample).verdict, sample, *sides) for place, sample, *sides in parts]


def boundary(
    modes: ContactModes, theta: np.ndarray, direction: np.ndarray, w: np.ndarray, number: int, search: GradientCheck
) -> list[Place]:
    """Return places before, at and after the contact switch nearest to theta along a direction; empty without a switch."""
    scale = scale_of(theta)

    def names(at: np.ndarray) -> list[str]:
        return modes(theta[:, None] + at * direction[:, None], np.repeat(w[:, None], at.size, axis=1))

    edge = switch(names, search.reach * scale)
    if edge is None:
        return []
    inner, outer = edge
    side = np.sign(outer - inner)
    at = {"before": inner - side * search.aside * scale, "at": inner, "after": outer + side * search.aside * scale}
    name = modes.switch(theta + inner * direction, theta + outer * direction, w)
    return [
        Place(point, number, 0, theta + s * direction, direction, w, name if point == "at" else "")
        for point, s in at.items()
    ]


def switch(names: Callable[[np.ndarray], list[str]], reach: float) -> tuple[float, float] | None:
    """Return the two arguments nearest to 0, within ``reach``, between which the name changes; None if it never does.

    Each pass evaluates a grid of arguments and refines the interval of the first change, until its length is about the
    floating-point spacing at ``reach``.
    """
    half = np.linspace(0.0, reach, COLUMNS_AT_ONCE // 2)
    values = names(np.concatenate([half, -half]))
    sides = ((1.0, values[: half.size]), (-1.0, values[half.size :]))
    changes = [(index, sign) for sign, side in sides if (index := _change(side))]
    if not changes:
        return None
    index, sign = min(changes, key=lambda change: change[0])
    low, high = sign * half[index - 1], sign * half[index]
    while abs(high - low) > 4.0 * np.spacing(reach):
        grid_ = np.linspace(low, high, COLUMNS_AT_ONCE)
        index = _change(names(grid_))
        if not index:
            break
        low, high = grid_[index - 1], grid_[index]
    return float(low), float(high)


def _change(names: Sequence[str]) -> int:
    """Return the index of the first name that differs from name 0, or 0."""
    return next((i for i, name in enumerate(names) if name != names[0]), 0)


# ---------------------------------------------------------------------------------------------- contact modes


@dataclass(frozen=True)
class ContactModes:
    """Names the contact modes of rollouts: the contacts that act in each step."""

    touching: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Returns which contacts act, boolean ``(horizon, n_contacts, B)``, for ``theta (d, B)`` and ``w (n_w, B)``."""
    names: tuple[str, ...]

    def __call__(self, theta: np.ndarray, w: np.ndarray) -> list[str]:
        """Return a short name of each rollout's mode."""
        return [signature(column) for column in self._every(theta, w)]

    def switch(self, inner: np.ndarray, outer: np.ndarray, w: np.ndarray) -> str:
        """Return the first difference between the modes of two thetas ``(d,)``, in words; empty without one."""
        before, after = self._every(np.stack([inner, outer], axis=1), np.repeat(w[:, None], 2, axis=1))
        differences = np.argwhere((before != after).T)
        if not len(differences):
            return ""
        step, contact = (int(i) for i in differences[0])
        sides = ("touching", "apart") if before[contact, step] else ("apart", "touching")
        return f"{self.names[contact]} in step {step} ({sides[0]} before, {sides[1]} after)"

    def _every(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return which contacts act, ``(B, n_contacts, horizon)``, from batches of a fixed width."""
        both, d = np.concatenate([theta, w]), len(theta)
        with np.errstate(all="ignore"):
            found = in_columns(lambda part: self.touching(part[:d], part[d:]), both, COLUMNS_AT_ONCE)
        return found.transpose(2, 1, 0)


def contact_modes(problem: Problem) -> ContactModes | None:
    """Return the function that names contact modes; None without contacts or if the states cannot be computed."""
    program = problem.program
    if not isinstance(program, Rollout) or not (program.scene.n_contacts or isinstance(program.scene, EngineScene)):
        return None
    # engines and implicit steps need the backend; other programs are faster in NumPy
    own = program.needs_root or "physics" in problem.provides
    simulated = problem if own else registry.make("backends", "numpy").compile(program)

    def touching(theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        theta = np.ascontiguousarray(np.broadcast_to(theta, (len(theta), w.shape[1])))
        states, controls = simulated.trajectory(theta, w)
        if isinstance(program.scene, EngineScene):
            return engine_contacts(problem).touching(states[:-1])
        return active_contacts(program, states, controls)

    try:
        touching(program.theta0[:, None], np.zeros((program.n_noise, COLUMNS_AT_ONCE)))
        return ContactModes(touching, contact_names(problem))
    except Unsupported:
        return None


def signature(contacts: np.ndarray) -> str:
    """Return a short name of ``contacts (n_contacts, horizon)``: the steps in contact, ``12-18 30``, split by ``;``.

    A name longer than 24 characters is truncated and ends in its checksum.
    """
    text = ";".join(_runs(row) for row in contacts)
    return text if len(text) <= 24 else f"{text[:14]}..{zlib.crc32(text.encode()):08x}"


def _runs(row: np.ndarray) -> str:
    parts = []
    for _, group in itertools.groupby(enumerate(np.flatnonzero(row)), key=lambda pair: pair[1] - pair[0]):
        steps = [int(step) for _, step in group]
        parts.append(str(steps[0]) if len(steps) == 1 else f"{steps[0]}-{steps[-1]}")
    return " ".join(parts) or "-"
