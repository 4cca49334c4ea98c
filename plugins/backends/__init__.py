"""Backends execute and differentiate programs."""
