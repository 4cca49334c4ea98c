"""The kind of a machine: what times depend on, and no name of it."""

from __future__ import annotations

import os
import platform

from bench.errors import printable
from bench.measure import timing
from bench.model.parameters import remember


@remember
def kind_of_machine() -> str:
    """Return processor, cores that this process may use and system: times of one kind can share a table."""
    facts = timing.conditions()
    cores = len(facts["affinity"] or ()) or os.cpu_count() or 1
    return f"{printable(facts['processor']) or platform.machine()}, {cores} cores, {platform.system()}"
