"""Builds plugins and compiles problems from the identity strings of the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from bench.errors import Unsupported
from bench.experiment.reference_backends import capable_backends
from bench.host.identity import parse_identity
from bench.host.parameters import build, parameters, singular
from bench.model import (
    Backend,
    ContactLaw,
    Decision,
    Integrator,
    MechanicalScene,
    Problem,
    Scene,
    compose,
    registry,
)


def make(kind: str, identity: str, defaults: Mapping[str, Any] | None = None) -> Any:
    """Return the plugin of an identity string: ``make("contacts", "penalty[stiffness=1e4]")``.

    ``defaults`` are a scene's own values of parameters. Raises :class:`bench.UserError` for an invalid name or value and
    :class:`bench.Unsupported` if a library that the plugin needs is not installed.
    """
    name, values = parse_identity(identity)
    plugin = registry.usable(kind, name)
    if reason := registry.find(kind, name).reason:
        raise Unsupported(f"{singular(kind)} '{name}' is {reason}")
    declared = parameters(plugin)
    return build(plugin, {key: value for key, value in (defaults or {}).items() if key in declared} | values)


def compile_problem(
    scene: Scene | str,
    contact: ContactLaw | str | None,
    integrator: Integrator | str,
    backend: str | None,
    decision: Decision | None = None,
    make: Callable[..., Any] = make,
) -> Problem:
    """Compile a scene on a backend; the contact law counts if the scene has contacts, the integrator if it has motion.

    Each part is an identity string or a plugin, and the backend None for the best that computes references. ``make`` builds plugins from identity strings. Raises the errors of
    :func:`make`, and :class:`bench.Unsupported` for a combination that cannot run.
    """
    given_scene: Scene = make("scenes", scene) if isinstance(scene, str) else scene
    law: ContactLaw | None = None
    step: Integrator | None = None
    if isinstance(given_scene, MechanicalScene):
        if given_scene.n_contacts:
            law = make("contacts", contact, given_scene.contact_values) if isinstance(contact, str) else contact
        step = make("integrators", integrator) if isinstance(integrator, str) else integrator
    program = compose(given_scene, law, step, decision or Decision())
    capable = [make("backends", backend)] if backend else capable_backends(program, for_references=True)
    if not capable:
        raise Unsupported(f"no installed backend runs scene {given_scene.name} for references: name one")
    engine: Backend = capable[0]
    if reason := engine.refusal(program):
        raise Unsupported(reason)
    problem = engine.compile(program)
    problem.provides, problem.backend = engine.provides, backend or engine.name
    return problem
