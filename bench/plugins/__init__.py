"""The built-in plugins under one name, wherever they lie: beside the package in a checkout, inside it when installed.

A top-level package called ``plugins`` would be hidden by any folder of that name where a command is run.
"""

from pathlib import Path

_HERE = Path(__file__).resolve().parent
__path__ = [str(next(place for place in (_HERE, _HERE.parents[1] / "plugins") if (place / "scenes").is_dir()))]
