"""Physics engines in a Python of their own: their processes, environments and backends.

An engine's file runs in the Python of the engine's environment and answers over pipes. Nothing of the engine is imported
in this process.
"""
