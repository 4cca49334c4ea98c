"""Compare gradient estimators through physics simulation against a certified gradient."""
