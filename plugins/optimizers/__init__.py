"""Optimizers: how costs and gradient estimates become the next theta."""
