"""Results of claims: measured once, kept as JSON, and measured again only when their code has changed."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench.claims import toolkit
from bench.claims.claim import UNDECIDED, Claim, Figure, verdict
from bench.errors import Unsupported
from bench.experiment.keys import module_hash, plugin_hash
from bench.model import registry
from bench.run.files import write_whole

FAILED = "failed"
"""The verdict of a claim whose code raised an error."""


@dataclass(frozen=True)
class ClaimResult:
    """What was found of one claim."""

    name: str
    verdict: str
    seconds: float
    """Processor seconds, which do not depend on what else the machine does."""
    figures: tuple[Figure, ...] = ()
    remark: str = ""
    """The reservation, or why nothing could be measured."""
    series: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""
    """Hash of the code that the numbers rest on."""
    plugins: tuple[tuple[str, str], ...] = ()
    """Kind and name of the plugins used."""

    def to_json(self) -> str:
        """Write the result as JSON, with every digit."""
        return json.dumps(asdict(self), indent=1)


def measured(claim: type[Claim]) -> ClaimResult:
    """Measure a claim now; an error in its code is a result of its own."""
    toolkit.used.clear()
    started = time.process_time()
    try:
        outcome = claim().measure()
    except Unsupported as reason:
        return ClaimResult(claim.name, UNDECIDED, time.process_time() - started, remark=str(reason))
    except Exception as error:
        return ClaimResult(claim.name, FAILED, time.process_time() - started, remark=f"{type(error).__name__}: {error}")
    used = tuple(sorted(toolkit.used))
    return ClaimResult(
        claim.name,
        verdict(outcome.figures, outcome.reservation),
        time.process_time() - started,
        tuple(outcome.figures),
        outcome.reservation,
        outcome.series,
        key_of(claim, used),
        used,
    )


def key_of(claim: type[Claim], used: tuple[tuple[str, str], ...]) -> str:
    """Return the hash of the claim's code, of what claims are made of, and of the plugins used."""
    digest = hashlib.sha256(module_hash(claim.__module__, toolkit.__name__).encode())
    for kind, name in used:
        digest.update(plugin_hash(registry.usable(kind, name)).encode())
    return digest.hexdigest()


def path_of(directory: Path, name: str) -> Path:
    """Return the file of a claim's result."""
    return directory / f"{name}.json"


def stored(directory: Path, claim: type[Claim]) -> ClaimResult | None:
    """Return the stored result, or None where there is none, or it is of other code, or it cannot be read."""
    try:
        values = json.loads(path_of(directory, claim.name).read_text())
        values["figures"] = tuple(Figure(**one) for one in values["figures"])
        values["plugins"] = tuple((kind, name) for kind, name in values["plugins"])
        result = ClaimResult(**values)
        return result if result.key == key_of(claim, result.plugins) else None
    except Exception:
        # whatever is wrong with the file, measuring again mends it
        return None


def keep(directory: Path, result: ClaimResult) -> None:
    """Store a result, unless it failed: that is tried again."""
    if result.key:
        write_whole(path_of(directory, result.name), result.to_json().encode())


def off_by(figure: Figure) -> float:
    """Return the difference over the published number, NaN where that is 0."""
    return (figure.measured - figure.value) / abs(figure.value) if figure.value else math.nan
