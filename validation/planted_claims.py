"""Plants one bug at a time in a plugin and runs claims that use it: `python validation/planted_claims.py [BUG...]`.

Prints a table of the bugs, the claims that were run and those that fail. A bug that no claim notices ends with status 1.
"""

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from unittest import mock

from bench.plugins.contacts.complementarity import Complementarity
from bench.plugins.contacts.impulse import Impulse
from bench.plugins.estimators.inverse_variance import InverseVariance, halves

from bench.claims import discovery, results
from bench.claims.claim import NOT_REPRODUCED
from bench.model import Problem, State, registry


def scaled(factor):
    """Return a wrapper that multiplies a method's result."""
    return lambda original, self, *a, **k: factor * original(self, *a, **k)


def halved_kappa(original, self, ops, contact, before, free, dt):
    return original(replace(self, kappa=self.kappa / 2), ops, contact, before, free, dt)


def swapped_weights(original, self, problem, theta, noise):
    first, zeroth = halves(problem, theta, noise)
    v1, v0 = first.var(axis=1, ddof=1), zeroth.var(axis=1, ddof=1)
    weight = v1 / (v0 + v1)
    return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1), {"weight": weight}


def early_impact(original, self, ops, contact, before, free, dt):
    change = original(self, ops, contact, before, free, dt)
    return State(0.9 * change.q, change.v)


def fast_step(original, self, dynamics, state, u, dt):
    return original(self, dynamics, state, u, 1.05 * dt)


CLAIMS = {
    "estimators": {
        "fobg": ("C5", "C6", "C19"),
        "inverse_variance": ("C19",),
        "measure_valued": ("C6",),
        "randomized_smoothing": ("C7",),
        "reinforce": ("C1", "C5", "C6"),
        "sphere_smoothing": ("C7",),
    },
    "contacts": {"penalty": ("C14", "C18"), "straight_through": ("C15",)},
    "integrators": {"event_driven": ("C13",), "semi_implicit_euler": ("C8", "C13")},
}
"""The claims that use a plugin, by kind and name. `impulse` and `complementarity` have bugs of their own below."""


def _bugs():
    yield "kappa halved", (Complementarity, "impulse", halved_kappa, ("C5",))
    yield "time of impact .9 dt", (Impulse, "impulse", early_impact, ("C8", "C13"))
    yield "score 5% large", (Problem, "score", scaled(1.05), ("C1", "C5", "C6"))
    yield "weights swapped", (InverseVariance, "estimate_with_diagnostics", swapped_weights, ("C19",))
    for kind, method, bug, wrapper in (
        ("estimators", "estimate", "5% large", scaled(1.05)),
        ("contacts", "force", "force 5% large", scaled(1.05)),
        ("integrators", "step", "step 5% long", fast_step),
    ):
        for name, claims in CLAIMS[kind].items():
            yield f"{name} {bug}", (registry.usable(kind, name), method, wrapper, claims)


BUGS = dict(_bugs())
"""Bugs by name."""


def verdicts(bug):
    """Return the verdict of each claim that is run under a bug, or its error; nothing may have been compiled before."""
    owner, name, wrapper, claims = BUGS[bug]
    original, found = getattr(owner, name), {}
    with mock.patch.object(owner, name, lambda self, *a, **k: wrapper(original, self, *a, **k)):
        for claim in claims:
            try:
                found[claim] = results.measure(discovery.claims()[claim]).verdict
            except Exception as error:
                found[claim] = f"{type(error).__name__}: {error}"
    return found


def failing(bugs):
    """Yield each bug, the claims that are run under it, and those that are then not reproduced."""
    # a process for each bug: a program that was compiled without the bug would run without it
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        for bug, found in zip(bugs, pool.map(verdicts, bugs), strict=True):
            yield bug, list(found), [claim for claim, verdict in found.items() if verdict == NOT_REPRODUCED]


def main(bugs):
    """Print a line per bug; return 1 if a bug passes every claim that is run."""
    missed = 0
    for bug, claims, failed in failing(bugs or BUGS):
        missed += not failed
        print(f"| {bug} | {', '.join(claims)} | {', '.join(failed) or 'none'} |", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
