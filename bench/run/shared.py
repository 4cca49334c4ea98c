"""Stores what the cells of several experiments share, references, descents and optima, beside the experiments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from bench.experiment.experiment import Experiment
from bench.host import reads
from bench.model import registry
from bench.run.files import make_directory, write_whole
from bench.run.rows import read_object


class Shared:
    """JSON files in the folder ``references``, each with the hashes of what code from outside has read for it."""

    def __init__(self, experiment: Experiment) -> None:
        # absolute, since a plugin may change the working folder
        self.folder = experiment.results_dir.absolute() / "references"
        self._present = reads.Present(registry.environment())

    def load(self, name: str) -> dict[str, Any] | None:
        """Return a stored result; None if the file is missing or unreadable, or something that it has read has changed."""
        found = read_object(self.folder / f"{name}.json")
        read = found.pop("reads", "")
        if not found or not isinstance(read, str) or self._present.change(read):
            return None
        reads.include(read)
        return found

    def save(self, name: str, found: Mapping[str, Any], read: str | None = None) -> None:
        """Store a result with what has been ``read`` for it, by default all that code from outside has read here."""
        make_directory(self.folder)
        content = {**found, "reads": reads.manifest() if read is None else read}
        write_whole(self.folder / f"{name}.json", json.dumps(content, default=lambda value: value.tolist()).encode())
