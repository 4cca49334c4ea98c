"""Measures the number of references of one program from which ``fused`` is faster than ``jax``.

``python tests/programs/fused_references.py`` prints, for each scene that bench-self compares, the seconds of the first
reference, which includes compilation without a cache on disk, and of the second reference, on both backends.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import yaml

from bench.benchself import rollouts
from bench.measure.reference import certify
from bench.model import registry

SAMPLES, TOLERANCE = 131_072, 0.005


def seconds(settings: dict[str, Any], scene: dict[str, Any], backend: str) -> tuple[float, float]:
    """Return the seconds of the first reference, with compilation, and of the second."""
    own = {**settings, "scene": scene["scene"], "values": scene.get("values", {})}
    provides = registry.find("backends", backend).plugin.provides  # type: ignore[union-attr]
    since = time.perf_counter()
    problem = rollouts.problem(own, backend, scene.get("contact"))
    certify(problem, provides, SAMPLES, TOLERANCE)
    first = time.perf_counter() - since
    since = time.perf_counter()
    certify(problem, provides, SAMPLES, TOLERANCE)
    return first, time.perf_counter() - since


def main() -> None:
    """Print a line per scene."""
    settings = yaml.safe_load((Path(__file__).parents[2] / "conf" / "bench_self.yaml").read_text())
    for name in ("jax", "fused"):
        seconds(settings, {"scene": "double_integrator"}, name)  # so that the imports are not timed
    for scene in settings["compared"]["scenes"]:
        (first, after), (fused_first, fused_after) = (seconds(settings, scene, name) for name in ("jax", "fused"))
        start, saved = (fused_first - fused_after) - (first - after), after - fused_after
        least = max(1, math.ceil(start / saved)) if saved > 0 else math.inf
        print(
            f"{scene['scene']:16} jax {first:.2f} s, then {after:.3f} s; fused {fused_first:.2f} s, then "
            f"{fused_after:.3f} s: fused is faster from {least} references of one program on",
            flush=True,
        )


if __name__ == "__main__":
    main()
