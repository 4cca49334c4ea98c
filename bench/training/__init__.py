"""Training of neural policies: environments, networks, windows, values and evaluation. JAX is imported when used."""
