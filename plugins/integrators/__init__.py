"""Integrators: time-stepping maps."""
