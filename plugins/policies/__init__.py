"""Policies map observations to controls."""
