"""Rollouts as one native loop: scalar code from a traced step, its adjoint, and the loops around both."""
