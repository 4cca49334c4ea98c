"""The built-in plugins as one package, from beside ``bench`` in a checkout and from inside it in an installation.

A top-level package called ``plugins`` would be shadowed by a folder of that name in the working folder.
"""

from pathlib import Path

_HERE = Path(__file__).resolve().parent
__path__ = [str(next(place for place in (_HERE, _HERE.parents[1] / "plugins") if (place / "scenes").is_dir()))]
