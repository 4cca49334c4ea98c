"""Someone's own simulator: is its gradient right, where does it break, what to use, and what does that cost?"""

from bench.examine.examination import examine
from bench.examine.report import Report

__all__ = ["Report", "examine"]
