"""Examines a user's own simulator: whether its gradient is right, where it breaks, which method to use, and its cost."""

from bench.examine.examination import examine
from bench.examine.report import Report

__all__ = ["Report", "examine"]
