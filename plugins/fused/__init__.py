"""Code generation for the ``fused`` backend: scalar code of a traced step, its adjoint, and the loops around both."""

REVISION = 1
"""Raised when a stored number of the backend moves by a change of this folder."""
