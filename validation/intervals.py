"""Measures the coverage of the intervals of bias and variance: `python validation/intervals.py [SEEDS [STRIDE]]`.

Cells are the ridges of the bank. The bias of every estimator is known there: 0 for unbiased estimators, the slopes of the
jumps for first order, the difference of two smoothings for another radius. The true variance is computed from a million
independent terms. No cell was used to choose a constant of the intervals. Intervals are computed as in a study, from the
estimates, the sums of their terms and the estimator's declarations. Sets of estimates with remarks are counted separately.
"""

import sys
from collections import defaultdict
from dataclasses import dataclass

import bank
import numpy as np
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.randomized_smoothing import RandomizedSmoothing
from bench.plugins.estimators.reinforce import Reinforce

from bench.measure.statistics import Truth, summarise
from bench.model import SampleMean, compose
from bench.model.estimator import columns, per_repeat

LEAST, MOST = 0.91, 0.99
ROUNDING = 1e-9
"""Relative error of the numpy backend's gradients, which are differences."""
PRECISE, PART = 1 << 20, 1 << 16
"""Number of samples for the true variance, and of samples per batch."""
WIDE = 1.5
"""Standard deviation of these samples, which are importance-weighted, so that tails are sampled often."""
SIZES = ((16, 16), (16, 100), (64, 16), (64, 100))
"""Repeats and samples of the cells, in turn."""


@dataclass(frozen=True)
class Cell:
    """An estimator on a ridge, with the norm of its bias."""

    label: str
    scene: bank.Ridge
    estimator: SampleMean
    bias: float
    repeats: int
    samples: int

    @property
    def smooth(self):
        """The scene without its jumps; it has the same derivative wherever the scene has a derivative."""
        kept = [(p, a) for p, a in zip(self.scene.pieces, self.scene.along, strict=True) if "step" not in p.name]
        pieces, along = zip(*kept, strict=True) if kept else ((bank.power(1, 0.0),), self.scene.along[:1])
        return bank.Ridge(pieces, along, self.scene.start, self.scene.sigma)


def cells():
    """Return every pair of ridge and estimator whose bias has a closed form, as cells."""
    return [
        Cell(case.label, case.program.scene, estimator, bias, *SIZES[i % len(SIZES)])
        for i, (case, estimator, bias) in enumerate(_pairs())
    ]


def _pairs():
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


@dataclass(frozen=True)
class Held:
    """Whether each interval of one set of estimates contains the true value, and the remark of its row."""

    bias: bool
    variance: bool
    per_sample: bool
    note: str


def variance_of_a_term(cell):
    """Return the trace of the covariance of one term, by importance sampling with standard deviation :data:`WIDE`."""
    theta, d = cell.scene.start, cell.scene.start.size
    # a difference across a jump is not a derivative
    problem = Numpy().compile(compose(cell.smooth if isinstance(cell.estimator, Fobg) else cell.scene))
    draw = np.random.default_rng([8, d, len(cell.label)])
    mean, square, weight, centre = np.zeros(d), 0.0, 0.0, None
    for _ in range(PRECISE // PART):
        w = WIDE * draw.standard_normal((d, PART))
        weights = WIDE**d * np.exp((w * w).sum(axis=0) * (0.5 / WIDE**2 - 0.5))
        terms = cell.estimator.terms(problem, theta, w)
        # without centring, the variance of terms that hardly differ would be a difference of large numbers
        centre = terms @ weights / weights.sum() if centre is None else centre
        terms = terms - centre[:, None]
        mean += terms @ weights
        square += float((terms * terms).sum(axis=0) @ weights)
        weight += float(weights.sum())
    return square / weight - float(mean @ mean) / weight**2


def estimates(cell, problem, noise):
    """Return the estimates ``(R, d)``, and sums and squares of their terms minus the first repeat's mean, as in a study."""
    terms = per_repeat(cell.estimator.terms(problem, cell.scene.start, columns(noise)), noise)
    rest = terms - terms[0].mean(axis=0)
    return terms.mean(axis=1), (rest.sum(axis=1), np.einsum("rnd,rnd->r", rest, rest))


def covered(cell, seeds):
    """Return the coverage of each of ``seeds`` sets of estimates."""
    problem = Numpy().compile(compose(cell.scene))
    d = cell.scene.start.size
    draw = np.random.default_rng([7, d, cell.repeats, cell.samples, len(cell.label)])
    single, truth = variance_of_a_term(cell), Truth.exact(cell.scene.truth())
    slack = ROUNDING * (1.0 + truth.norm)
    unbiased = cell.estimator.declares_unbiased(problem.program)

    def within(low, value, high, rest):
        return low <= value + rest and value <= high + rest

    every = []
    for _ in range(seeds):
        rows, terms = estimates(cell, problem, draw.standard_normal((cell.repeats, cell.samples, d)))
        found = summarise(rows, truth, cell.samples, terms, unbiased)
        # terms that differ only by the rounding of a difference have variance 0
        rounding = slack**2 * max(1.0, cell.samples)
        every.append(
            Held(
                within(found.bias_low, cell.bias, found.bias_high, slack),
                within(found.variance_low, single / cell.samples, found.variance_high, rounding),
                within(found.variance_per_sample_low, single, found.variance_per_sample_high, rounding),
                found.note,
            )
        )
    return every


def shares(held):
    """Return the shares of sets whose intervals contain the true bias, variance and variance per sample."""
    bias, variance, each = np.mean([(one.bias, one.variance, one.per_sample) for one in held], axis=0).tolist()
    return bias, variance, each


def main(seeds=40, stride=1):
    """Print coverage; return 1 unless coverage without remarks is within 91% to 99%."""
    total = defaultdict(list)
    for cell in cells()[::stride]:
        held = covered(cell, seeds)
        plain = [one for one in held if not one.note]
        kind = type(cell.estimator).__name__
        # all sets, since a remark may follow from the interval itself
        total["all sets"] += held
        total[f"all sets of {kind}"] += held
        total["without remark"] += plain
        total["of these biased" if cell.bias else "of these unbiased"] += plain
        total[f"of these {kind}"] += plain
    for name, held in sorted(total.items()):
        bias, variance, each = (100 * share for share in shares(held))
        print(f"{name}: {len(held)} sets, bias covered {bias:.1f}%, variance {variance:.1f}%, per sample {each:.1f}%")
    return int(not all(LEAST <= share <= MOST for share in shares(total["without remark"])))


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in sys.argv[1:3])))
