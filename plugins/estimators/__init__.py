"""Estimators of grad J from sampled costs, gradients and scores."""
