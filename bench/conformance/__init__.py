"""The conformance kit: every fact that a plugin declares is verified by running the plugin.

Each check is one function, registered for a kind of plugin. It takes an instance and returns its measurements as text,
or raises :class:`Failed` or :class:`Skipped`. A plugin is checked with its default parameters and once more for every
other choice it offers (``reinforce[baseline=none]``). Noise has fixed seeds, so results repeat. Limits on sample
means are 4.5 standard errors: one false alarm in 150,000.

``python -m bench check`` runs them in pytest; :func:`parametrize` makes each check a test of one's own.
"""

# importing these modules registers their checks
from bench.conformance import (
    backends,
    contacts,
    effects,
    estimators,
    generic,
    integrators,
    optimizers,
    policies,
    scenes,
)
from bench.conformance.kit import Failed, Skipped, main, parametrize, verifies

__all__ = [
    "Failed",
    "Skipped",
    "backends",
    "contacts",
    "effects",
    "estimators",
    "generic",
    "integrators",
    "main",
    "optimizers",
    "parametrize",
    "policies",
    "scenes",
    "verifies",
]
