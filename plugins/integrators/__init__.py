"""Time-stepping maps."""
