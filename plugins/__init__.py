"""The built-in plugins: one class per file, found by being there."""
