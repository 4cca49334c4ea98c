"""Training of neural policies: environments, networks, windows and values."""

import os

# Equinox reads this when it is imported first: a failed solve of the implicit backend then spoils its own column only
os.environ.setdefault("EQX_ON_ERROR", "off")
