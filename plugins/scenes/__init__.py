"""Minimal physical problems and plain functions: what is differentiated."""
