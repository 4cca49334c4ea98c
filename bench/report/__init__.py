"""Shared functions for tables, charts and pages, independent of any study or plugin."""
