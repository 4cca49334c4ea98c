"""Trainers: one class per file."""
