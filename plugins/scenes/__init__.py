"""Scenes: minimal physical problems and plain functions to differentiate."""
