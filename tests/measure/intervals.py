"""How often the intervals of bias and variance hold the truth: `python tests/measure/intervals.py [seeds a cell]`.

Cells are the ridges of the bank, whose bias is known for every estimator: none for those that are unbiased, the slopes
of the jumps for first order, the difference of two smoothings for another radius. None was used to choose a constant of
the intervals. Cells with remarks are counted apart.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import bank
import numpy as np
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.randomized_smoothing import RandomizedSmoothing
from bench.plugins.estimators.reinforce import Reinforce

from bench.measure.statistics import Truth, summarise
from bench.model import SampleMean, compose
from bench.model.estimator import columns

LEAST, MOST = 0.91, 0.99
ROUNDING = 1e-9
"""Share of the gradient that the differences of the numpy backend leave."""
PRECISE = 1 << 17
"""Samples that a variance is held to."""
SIZES = ((16, 16), (16, 100), (64, 16), (64, 100))
"""Repeats and samples of the cells, in turn."""


@dataclass(frozen=True)
class Cell:
    """An estimator on a ridge, with the norm of its bias."""

    label: str
    scene: bank.Ridge
    estimator: SampleMean | Reinforce
    bias: float
    repeats: int
    samples: int

    @property
    def rare(self) -> bool:
        """Whether something begins 2.4 standard deviations away, which an interval of what occurred cannot know."""
        places = [
            p.name.split("(")[1].split(",")[0]
            for p in self.scene.pieces
            if p.name.startswith(("ramp", "step", "hinge"))
        ]
        return any(abs(float(at)) > 2.4 for at in places)


def cells() -> list[Cell]:
    """Every pair of ridge and estimator whose bias has a closed form."""
    return [
        Cell(case.label, case.program.scene, estimator, bias, *SIZES[i % len(SIZES)])
        for i, (case, estimator, bias) in enumerate(_pairs())
    ]


def _pairs() -> Iterator[tuple[bank.Case, SampleMean | Reinforce, float]]:
    for i, case in enumerate(bank.ridges()):
        scene = case.program.scene
        jumps = [
            a * p.slope(0.0, scene.sigma) for p, a in zip(scene.pieces, scene.along, strict=True) if "step" in p.name
        ]
        missed = float(np.linalg.norm(sum(jumps))) if jumps else 0.0
        if "bump" not in case.label and not jumps:
            yield case, Fobg(), 0.0
        elif jumps and i % 2:
            yield case, Fobg(), missed
        if i % 2:
            yield case, Reinforce(), 0.0
        else:
            wide = 2.0 * scene.sigma
            other = bank.Ridge(scene.pieces, scene.along, scene.start, wide).truth()
            yield case, RandomizedSmoothing(radius=wide), float(np.linalg.norm(other - case.truth))


def covered(cell: Cell, seeds: int) -> tuple[list[tuple[bool, bool]], list[tuple[bool, bool]]]:
    """Return, for sets of estimates without and with a remark, whether bias and variance were in their intervals."""
    problem = Numpy().compile(compose(cell.scene))
    theta, d = cell.scene.start, cell.scene.start.size
    draw = np.random.default_rng([7, d, cell.repeats, cell.samples, len(cell.label)])
    single = cell.estimator.estimate(problem, theta, draw.standard_normal((PRECISE // cell.samples, cell.samples, d)))
    variance = float(single.var(axis=0, ddof=1).sum())
    truth = Truth.exact(cell.scene.truth())
    slack = ROUNDING * (1.0 + truth.norm)
    plain, remarked = [], []
    for _ in range(seeds):
        w = draw.standard_normal((cell.repeats, cell.samples, d))
        if cell.scene.start.size != columns(w).shape[0]:
            raise AssertionError(cell.label)
        found = summarise(cell.estimator.estimate(problem, theta, w), truth, cell.samples)
        bias = found.bias_low - slack <= cell.bias <= found.bias_high + slack
        spread = found.variance_low <= variance * (1 + 1e-9) and variance <= found.variance_high * (1 + 1e-9) + slack**2
        (remarked if found.note else plain).append((bias, spread))
    return plain, remarked


def main(seeds: int = 40, stride: int = 1) -> int:
    """Print the coverage without and with remarks, and the cells worst covered; return 1 where it is not 91 to 99%."""
    total: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    worst = []
    every = cells()[::stride]
    for cell in every:
        plain, remarked = covered(cell, seeds)
        total["without remark"] += plain
        total["with a remark"] += remarked
        total["of these biased" if cell.bias else "of these unbiased"] += plain
        total[f"of these R={cell.repeats}"] += plain
        if not cell.rare:
            total["of these without an event rarer than 1 in 100"] += plain
        if len(plain) >= seeds / 2:
            share = float(np.mean([bias for bias, _ in plain]))
            worst.append((share, f"{type(cell.estimator).__name__} {cell.label} R={cell.repeats} N={cell.samples}"))
    print(f"{len(every)} cells, {seeds} sets of estimates each")
    for name, results in total.items():
        if results:
            bias, spread = np.mean(results, axis=0)
            print(f"{name}: {len(results)} sets, bias covered {100 * bias:.1f}%, variance {100 * spread:.1f}%")
    sound = sum(share >= LEAST - 2.5 * np.sqrt(0.95 * 0.05 / seeds) for share, _ in worst)
    print(f"{sound} of {len(worst)} cells without remarks are not below 91% by more than chance; the lowest:")
    for share, label in sorted(worst)[:8]:
        print(f"  {100 * share:.0f}%  {label}")
    return int(not LEAST <= float(np.mean([bias for bias, _ in total["without remark"]])) <= MOST)


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in sys.argv[1:3])))
