"""Selects the backends that can run a program, compute its reference gradient, or provide its step Jacobians."""

from __future__ import annotations

from contextlib import suppress

from bench.host.parameters import build, remember
from bench.model import Backend, Program, registry


def capable_backends(program: Program, for_references: bool = False) -> list[Backend]:
    """Return the available backends, with default parameters, that can run a program.

    With ``for_references``, only those that compute references are returned, best first.
    """
    backends = []
    for entry in registry.entries()["backends"].values():
        if entry.plugin is None or not entry.available or not issubclass(entry.plugin, Backend):
            continue
        if (
            for_references and entry.plugin.reference_rank is None
        ):  # checked first, since `refusal` may have to trace the program
            continue
        with suppress(Exception):  # a backend that fails here cannot run the program
            backend = _default(entry.plugin)
            if backend.refusal(program) is None and backend.unavailable_reason() is None:
                backends.append(backend)
    return sorted(backends, key=lambda backend: backend.reference_rank or 0) if for_references else backends


@remember
def _default(plugin: type[Backend]) -> Backend:
    backend = build(plugin, {})
    assert isinstance(backend, Backend)
    return backend


def backends_with_jacobians(program: Program) -> list[str]:
    """Return the names of the available backends whose problems provide step Jacobians of a program."""
    return [backend.name for backend in capable_backends(program) if backend.compile(program).gives_jacobians]
