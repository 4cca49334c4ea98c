"""What executes a program and how it differentiates it."""
