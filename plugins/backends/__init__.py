"""Backends: they execute a program and differentiate it."""
