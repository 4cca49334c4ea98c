"""Estimators: how sampled costs, gradients and scores become an estimate of grad J."""
