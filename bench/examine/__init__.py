"""Examines a user's simulator: whether its gradient is right, where its cost breaks, and which method to use."""
