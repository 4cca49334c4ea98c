"""Small cases with certified values and derivatives, by which the authors of a differentiable simulator check it.

The folder needs NumPy only and imports nothing of this package, so that it can be copied.
"""

from . import metamorphic
from .runner import Case, cases, check, run, verify

__all__ = ["Case", "cases", "check", "metamorphic", "run", "verify"]
