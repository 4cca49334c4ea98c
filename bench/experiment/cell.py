"""A cell, one point of a sweep: its plugins and counts, its identity as JSON and as a hash, and reasons for refusal."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

from bench.errors import Unsupported, UserError, failure, printable
from bench.experiment.experiment import Budget
from bench.experiment.keys import COMPARED, SHARED, counted, fingerprint, hashed, raised, revisions_of
from bench.experiment.parameters import labels
from bench.experiment.reference_backends import capable_backends
from bench.host.identity import described, identity
from bench.host.parameters import parameters, singular, values
from bench.measure import descent, reference
from bench.measure.descent import DescentPoint
from bench.model import (
    IID,
    Backend,
    ContactLaw,
    Decision,
    Design,
    Estimator,
    Integrator,
    Plugin,
    Program,
    Scene,
    Smoothing,
    compose,
    registry,
)
from bench.model.program import OWN, idle

DESCENDED = ("contact", "integrator", "backend")
"""The parts of the program that is descended, besides the scene of the cell, in the order of the setting ``path``."""
_ranked: dict[str, tuple[Backend, ...]] = {}
"""Cache of the backends that can compute references, best first, by program key."""
_reference_keys: dict[tuple[str, ...], str] = {}
"""Cache of the keys of references, by all that decides them."""


@dataclass(frozen=True)
class Cell:
    """One point of a sweep: a plugin on each axis, counts, a seed, and the study that measures it."""

    parts: Mapping[str, Plugin | None]
    """Plugins by axis; None if the scene has no such part."""
    samples: int
    repeats: int
    seed: int
    study: Any
    """The :class:`bench.experiment.study.Study` that measures it; its module imports this one."""
    decision: Decision = OWN
    timing: bool = True
    """Whether the row records timings."""
    budget: Budget | None = None
    """Budget of its reference gradient; None if the study needs none."""
    path: Cell | None = None
    """The start of the descent that theta is on, with the program that is descended; None where nothing is descended."""
    point: DescentPoint | None = None
    """Theta on that descent; None before it is computed."""
    swept: tuple[str, ...] = ()
    """Parameters of its scene that are axes of the sweep."""

    @property
    def scene(self) -> Scene:
        """The scene."""
        return cast(Scene, self.parts["scene"])

    @property
    def contact(self) -> ContactLaw | None:
        """The contact law, or None."""
        return cast("ContactLaw | None", self.parts["contact"])

    @property
    def integrator(self) -> Integrator | None:
        """The integrator, or None."""
        return cast("Integrator | None", self.parts["integrator"])

    @property
    def backend(self) -> Backend:
        """The backend."""
        return cast(Backend, self.parts["backend"])

    @property
    def estimator(self) -> Estimator:
        """The estimator; raises KeyError in a study without that axis."""
        return cast(Estimator, self.parts["estimator"])

    def with_part(self, axis: str, plugin: Plugin | None) -> Cell:
        """Return this cell with another plugin on one axis."""
        return dataclasses.replace(self, parts={**self.parts, axis: plugin})

    # ---------------------------------------------------------------------------------------------- identity

    @cached_property
    def key(self) -> str:
        """Hash of everything that decides the cell's numbers, except library versions, which have a column."""
        own = None if self.budget is None else [self.reference_key, raised(revisions_of(COMPARED))]
        # a study may use the best backend besides the cell's own
        best = fingerprint(next(iter(self.ranked_backends), None))
        return hashed(
            {axis: fingerprint(part) for axis, part in self.parts.items()},
            [self.samples, self.repeats, self.seed, self.timing],
            own,
            best,
            self.budget and counted(self.budget),
            self._theta_hashed(),
            fingerprint(self.study),
            raised(revisions_of(SHARED)),
        )

    @cached_property
    def program_key(self) -> str:
        """Hash of everything that decides the program."""
        parts = [fingerprint(part) for part in (self.scene, self.contact, self.integrator)]
        return hashed(parts, self._theta_hashed(), raised(revisions_of(SHARED)))

    @cached_property
    def descent_key(self) -> str:
        """Hash of everything that decides the descent from this cell's theta0; raises :class:`Unsupported` if no backend computes it."""
        return hashed(self.program_key, fingerprint(self.descent_backend), descent.REVISION)

    @property
    def descent_backend(self) -> Backend:
        """The backend that computes the descent: the given one, else the best that computes references."""
        given = self.parts["backend"]
        ranked = self.ranked_backends if given is None else (self.backend,)
        if not ranked:
            raise Unsupported(f"no installed backend computes a descent of scene {self.scene.name}")
        return ranked[0]

    @cached_property
    def reference_key(self) -> str:
        """Hash of everything that decides the reference gradient; raises ValueError if the study computes none."""
        if self.budget is None:
            raise ValueError(
                f"study {self.study.name} computes no reference: add a column `reference_method` to its columns to get one"
            )
        backend, estimator = fingerprint(self.reference_backends[0]), fingerprint(self.parts.get("estimator"))
        given = (self.program_key, repr(self.budget), backend, estimator)
        if given not in _reference_keys:
            radius, methods = [], dict(reference.REVISIONS)
            # a combination without meaning has no smoothing; an error shows up in the cell's own row
            with suppress(Exception):
                smoothing = self.smoothing()
                radius = [] if smoothing is None else [[smoothing.shape, smoothing.radius]]
                if smoothing is None:
                    methods = reference.revisions(self.program(), self.reference_backends[0].provides)
            budget = list(counted(self.budget).values())
            _reference_keys[given] = hashed(self.program_key, budget, backend, *radius, raised(methods))
        return _reference_keys[given]

    @property
    def reference_backends(self) -> tuple[Backend, ...]:
        """The backends that can run the program for a reference, best first, the cell's own backend last.

        A backend with physics of its own runs its own program, so only it can compute that program's reference.
        """
        return (*(() if "physics" in self.backend.provides else self.ranked_backends), self.backend)

    @property
    def ranked_backends(self) -> tuple[Backend, ...]:
        """The available backends that compute references and can run the scene's own program, best first."""
        if self.program_key not in _ranked:
            _ranked[self.program_key] = ()
            with suppress(Unsupported, UserError):
                _ranked[self.program_key] = tuple(capable_backends(self.program(), for_references=True))
        return _ranked[self.program_key]

    def smoothing(self) -> Smoothing | None:
        """Return the smoothing of the objective that the estimator is compared with; None for J_sigma."""
        estimator = self.parts.get("estimator")
        return estimator.smoothing(self.program()) if isinstance(estimator, Estimator) else None

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Every parameter of every plugin, defaults included, with the study, theta and the reference budget."""
        entries: dict[str, Any] = {"study": described(self.study)}
        entries |= {axis: described(part) for axis, part in self.parts.items()}
        return entries | {"theta": self._theta(), "reference": self.budget and vars(self.budget)}

    def _theta(self) -> dict[str, Any] | None:
        """Return theta for the row's parameters; on a descent, also the identity strings of what is descended."""
        if self.decision == OWN:
            return None
        theta = dataclasses.asdict(self.decision)
        if self.path is None:
            return theta
        parts = (self.path.parts[axis] for axis in DESCENDED)
        return theta | {"path": ["none" if part is None else identity(part.name, values(part)) for part in parts]}

    def _theta_hashed(self) -> dict[str, Any] | None:
        """Return theta for keys, which a share of 0 leaves as they were before descents existed."""
        theta = self._theta()
        if theta is None or self.path is None:
            return theta and {name: theta[name] for name in ("names", "at")}
        with suppress(Unsupported):
            return theta | {"path": self.path.descent_key}
        return theta | {"path": "none"}  # the cell is refused

    def columns(self) -> dict[str, Any]:
        """Return the identity columns of the cell's row, from its parameters and counts."""
        law = self.contact
        smoothing = getattr(law, law.smoothing) if law and law.smoothing else math.nan
        return {
            **labels(self.parameters),
            "noise": "parameter" if self.decision.names else self.scene.noise,
            "horizon": self._own_column("horizon", self.scene, default=0),
            "dt": self._own_column("dt", self.scene),
            "stiffness": self._own_column("stiffness", law, self.scene),
            "sigma": self.scene.sigma,
            "smoothing": smoothing,
            "draws": getattr(self.parts.get("estimator"), "draws", "iid"),
            "mirrored": float(getattr(self.parts.get("estimator"), "mirrored", False)),
            "descent": self.decision.descent,
            "samples": self.samples,
            "repeats": self.repeats,
            "dim": self._dim(),
            "seed": self.seed,
            "dtype": self.backend.dtype,
            "study": self.study.name,
            "parameters": json.dumps(self.parameters, separators=(",", ":"), allow_nan=False),
            "key": self.key,
        }

    def _own_column(self, name: str, *parts: Plugin | None, default: float = math.nan) -> float:
        """Return the parameter ``name`` of the first part that has it, or ``default``."""
        known = (part for part in parts if part is not None and name in parameters(type(part)))
        return next((float(getattr(part, name)) for part in known), default)

    def _dim(self) -> float:
        try:
            return len(self.decision.names) or int(self.scene.theta0().size)
        except KeyboardInterrupt:
            raise
        except BaseException:  # the cell's row reports the error
            return math.nan

    # ----------------------------------------------------------------------------------------------- program

    def program(self) -> Program:
        """Compose the program; raises :class:`Unsupported` if the parts do not fit together."""
        decision = self.study.decision(self.decision)
        if self.point is not None:
            decision = Decision(decision.names, self.point.theta)
        return compose(self.scene, self.contact, self.integrator, decision)

    def design(self, program: Program) -> Design:
        """Return how the noise of an estimate is drawn; independently in a study without estimators."""
        estimator = self.parts.get("estimator")
        return estimator.design(program, self.samples) if isinstance(estimator, Estimator) else IID

    @property
    def remarks(self) -> list[str]:
        """Remarks on parameters of the scene that are set and have no effect."""
        known = parameters(type(self.scene))
        names = (n for n in self.scene.without_effect(self.contact) if getattr(self.scene, n) != known[n].default)
        return [idle(name, self.scene, self.contact) for name in names]

    def refusal(self) -> tuple[str, str] | None:
        """Return status and reason if this cell cannot run, or None; an error raised by a plugin is a reason."""
        try:
            return self._refusal()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            result = failure(error)
            return result["status"], result["reason"]

    def _refusal(self) -> tuple[str, str] | None:
        """Return status and reason of the first plugin that is unavailable or does not fit the others, or None."""
        for part in self.parts.values():
            if part is not None:
                entry = registry.find(part.kind, part.name)
                if not entry.available:
                    return "unavailable", f"{singular(part.kind)} {part.name} is {entry.reason}"
                if reason := part.unavailable_reason():
                    return "unavailable", reason
        try:
            program = self.program()
            start = None if self.path is None else self.path.program()
        except (Unsupported, UserError) as error:  # another scene of the sweep may have this theta
            return "unsupported", printable(error)
        for name in self.scene.without_effect(self.contact):
            if name in self.swept:
                return "unsupported", f"{idle(name, self.scene, self.contact)}, so its values are no axis"
        if self.path is not None:
            if not self.study.descends:
                return "unsupported", f"study {self.study.name} starts where its own settings say: descent=0"
            if start is not None and (reason := self.path.descent_backend.refusal(start)):
                return "unsupported", f"its descent: {reason}"
        backend, estimator = self.backend, self.parts.get("estimator")
        if reason := backend.refusal(program):
            return "unsupported", reason
        if isinstance(estimator, Estimator) and (reason := estimator.refusal(program, backend.provides, backend.name)):
            return "unsupported", reason
        self.design(program)  # raises Unsupported where it cannot be drawn
        return None
