"""The conformance kit: each fact a plugin declares is verified by running it.

One function is one check, registered for a kind of plugin. It takes an instance, returns the numbers it measured,
and raises :class:`Failed` or :class:`Skipped`. A plugin is checked with its default parameters and once more for every
other choice it offers (``reinforce[baseline=none]``). Noise is drawn from fixed seeds, so that results repeat; limits on
sample means are set at 4.5 standard errors, a false alarm in 150,000.

``python -m bench check`` prints a line for each check; :func:`parametrize` makes each a test of its own in pytest.
"""

# the modules of checks register them as they are imported
from bench.conformance import backends, contacts, estimators, generic, integrators, optimizers, scenes
from bench.conformance.kit import CheckResult, Failed, Skipped, check, main, parametrize, verifies

__all__ = [
    "CheckResult",
    "Failed",
    "Skipped",
    "backends",
    "check",
    "contacts",
    "estimators",
    "generic",
    "integrators",
    "main",
    "optimizers",
    "parametrize",
    "scenes",
    "verifies",
]  # fmt: skip
