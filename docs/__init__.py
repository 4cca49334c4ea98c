"""The documents: their generated parts, their figures, and the site."""
