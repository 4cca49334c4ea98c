"""Optimizers compute the next theta from costs and gradient estimates."""
