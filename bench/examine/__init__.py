"""Examines a user's simulator: whether its gradient is right, where its cost breaks, and which method to use."""

UPDATE = "--bench-update"
"""The option of pytest and of the command that writes a baseline, also from a run that fails."""
