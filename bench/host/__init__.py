"""What every plugin has, whatever it models.

Parameters, an identity and a place in the registry; the files that its code reads, and guards around that code.
"""
