"""A function of a user's file, as the command line names it: ``mysim.py:cost`` or ``package.module:cost``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import UserError, failure, unknown


def attribute(text: str, otherwise: ModuleType | None = None) -> Any:
    """Return what ``FILE:NAME`` or ``MODULE:NAME`` names; a bare name is looked up in the module ``otherwise``.

    Raises :class:`UserError` where there is no such file or name, or where it fails when imported.
    """
    place, _, name = text.rpartition(":")
    if not place and otherwise is None:
        raise UserError(f"'{text}' names no function: give FILE:NAME, for example mysim.py:cost")
    module = load(place) if place else otherwise
    assert module is not None
    found: Any = module
    for part in name.split("."):
        if not hasattr(found, part):
            names = [own for own in vars(module) if not own.startswith("_")]
            raise unknown(f"name in {place or module.__name__}:", name, names)
        found = getattr(found, part)
    return found


def load(place: str) -> ModuleType:
    """Import a file or a module, once; its folder can be imported from, as when Python runs the file."""
    if not place.endswith(".py"):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError as error:
            raise UserError(
                f"there is no module '{place}': give a file, mysim.py:cost, or a module ({error})"
            ) from None
        except Exception as error:
            raise UserError(f"'{place}' cannot be imported: {failure(error)['reason']}") from None
    path = Path(place).expanduser().resolve()
    if not path.is_file():
        raise UserError(f"there is no file '{place}'")
    name = f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        spec.loader.exec_module(module)
    except SystemExit:
        del sys.modules[name]
        raise UserError(
            f"'{place}' ends the process when it is imported: put that under if __name__ == \"__main__\""
        ) from None
    except Exception as error:
        del sys.modules[name]
        raise UserError(f"'{place}' cannot be imported: {failure(error)['reason']}") from None
    return module
