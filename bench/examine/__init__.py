"""Examines a user's simulator: whether its gradient is right, where its cost breaks, and which method to use."""

from bench.examine.examination import examine
from bench.examine.report import Report

__all__ = ["Report", "examine"]
