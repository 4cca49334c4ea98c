"""Measurements of problems: references, statistics, noise, timing and gradient checks."""
