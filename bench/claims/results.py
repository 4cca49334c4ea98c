"""Measures claims and stores the results as JSON. A claim is measured again only if its code has changed."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.claims import toolkit
from bench.claims.claim import UNDECIDED, Claim, Figure, verdict
from bench.errors import Unsupported
from bench.experiment.keys import code_of, hashed
from bench.model import registry
from bench.run.files import write_whole

FAILED = "failed"
"""The verdict of a claim whose code raised an error."""


@dataclass(frozen=True)
class ClaimResult:
    """The result of one claim."""

    name: str
    verdict: str
    seconds: float
    """Processor time [s], which does not depend on other load."""
    figures: tuple[Figure, ...] = ()
    remark: str = ""
    """The reservation, or the reason why nothing could be measured."""
    series: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""
    """Hash of the revisions that the numbers depend on."""
    plugins: tuple[tuple[str, str], ...] = ()
    """Kind and name of the plugins used."""

    def to_json(self) -> str:
        """Return the result as JSON, with every digit."""
        return json.dumps(asdict(self), indent=1, default=np.ndarray.tolist)


def measure(claim: type[Claim]) -> ClaimResult:
    """Measure a claim. If its code raises an error, the result has the verdict ``failed``."""
    toolkit.used.clear()
    started = time.process_time()
    try:
        outcome = claim().measure()
    except Unsupported as reason:
        return ClaimResult(claim.name, UNDECIDED, time.process_time() - started, remark=str(reason))
    except Exception as error:
        return ClaimResult(claim.name, FAILED, time.process_time() - started, remark=f"{type(error).__name__}: {error}")
    used = tuple(sorted(toolkit.used))
    decided, seconds = verdict(outcome.figures, outcome.reservation), time.process_time() - started
    return ClaimResult(
        claim.name,
        decided,
        seconds,
        tuple(outcome.figures),
        outcome.reservation,
        outcome.series,
        key_of(claim, used),
        used,
    )


def key_of(claim: type[Claim], used: tuple[tuple[str, str], ...]) -> str:
    """Return the hash of the revisions of the claim, the contract of claims, and the plugins used."""
    return hashed(code_of(claim), [code_of(registry.usable(kind, name)) for kind, name in used])


def read(directory: Path, claim: type[Claim]) -> ClaimResult | None:
    """Return the stored result, or None if it is missing, unreadable or measured by other code."""
    try:
        values = json.loads((directory / f"{claim.name}.json").read_text())
        values["figures"] = tuple(Figure(**one) for one in values["figures"])
        values["plugins"] = tuple((kind, name) for kind, name in values["plugins"])
        result = ClaimResult(**values)
        return result if result.key == key_of(claim, result.plugins) else None
    except Exception:
        # a damaged file is replaced when the claim is measured again
        return None


def store(directory: Path, result: ClaimResult) -> None:
    """Store a result that has figures. A claim that failed or could not run is measured again next time."""
    if result.key:
        write_whole(directory / f"{result.name}.json", result.to_json().encode())
