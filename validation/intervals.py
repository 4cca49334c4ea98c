"""Measures the coverage of the 95% intervals by estimator: `python validation/intervals.py [SETS [STRIDE]]`, in percent.

Coverage is the share of simulated sets of estimates whose interval contains the true value. No set is left out: ``plain`` is
the share of sets without a remark. Cells are the ridges of the bank with three estimators, every STRIDE-th of them and each
with SETS sets. Without a STRIDE, ten times the sets are of exp(x) and a hinge that 1 sample in 160 meets with some
estimators, and of a smooth cost, a kink and a jump with every estimator and every design of its noise that it allows: the
second table has the lowest share of these costs. No cell was used to choose a constant of the intervals. Biases and
variances are from 262,144 samples of their own; a bias that is declared to be 0 is 0.
"""

import json
import math
import sys
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import bank
import numpy as np
import pandas as pd
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.randomized_smoothing import RandomizedSmoothing
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.studies.bias_variance.measure import summarise_diagnostics

from bench.host.identity import label
from bench.measure.noise import samples_of
from bench.measure.statistics import Truth, summarise
from bench.model import IID, SampleMean, Unsupported, columns, compose, per_repeat, registry
from bench.report.views import rmse_interval

LEAST, MOST = 0.91, 0.99
ROUNDING = 1e-9
"""Relative error of the numpy backend's gradients, which are differences."""
PRECISE, PART = 1 << 18, 1 << 16
"""Number of samples for the true values, and of samples per batch."""
WIDE = 1.5
"""Standard deviation of these samples, which are importance-weighted, so that tails are sampled often."""
SIZES = ((16, 16), (16, 100), (64, 16), (64, 100))
"""Repeats and samples of the bank's cells, in turn."""
STATISTICS = ("bias", "variance", "variance_per_sample", "rmse")
DESIGNS = {
    "iid": {},
    "mirrored": {"mirrored": True},
    "orthogonal": {"draws": "orthogonal"},
    "sobol": {"draws": "sobol"},
}
"""Designs of the noise by the names of columns."""


class Cell(NamedTuple):
    """An estimator on a scene of one class of costs."""

    cost: str
    scene: bank.Ridge
    estimator: Any
    repeats: int
    samples: int

    @property
    def smooth(self):
        """The scene without its jumps; it has the same derivative wherever the scene has a derivative."""
        kept = [(p, a) for p, a in zip(self.scene.pieces, self.scene.along, strict=True) if "step" not in p.name]
        pieces, along = zip(*kept, strict=True) if kept else ((bank.power(1, 0.0),), self.scene.along[:1])
        return bank.Ridge(pieces, along, self.scene.start, self.scene.sigma)


def bank_cells():
    """Return the ridges of the bank with first order, and zeroth order or smoothing by twice the noise, as cells."""
    pairs = []
    for i, case in enumerate(bank.ridges()):
        scene = case.program.scene
        if "bump" not in case.label and ("jump" not in case.label or i % 2):
            pairs.append((scene, Fobg()))
        pairs.append((scene, Reinforce(baseline="center") if i % 2 else RandomizedSmoothing(radius=2.0 * scene.sigma)))
    return [Cell("bank", *pair, *SIZES[i % len(SIZES)]) for i, pair in enumerate(pairs)]


def tail_cells():
    """Return cells of exp(x) and the hinge with some estimators."""
    one = [np.ones(1)], np.zeros(1), 1.0
    some = [
        registry.make("estimators", name, values)
        for name, values in (
            ("fobg", {}),
            ("reinforce", {}),
            ("reinforce", {"baseline": "center"}),
            ("control_variate", {}),
            ("randomized_smoothing", {}),
            ("randomized_smoothing", {"variant": "forward"}),
        )
    ]
    return [
        Cell(cost, bank.Ridge([piece], *one), estimator, repeats, 16)
        for cost, piece in (("exp(x)", bank.growth(1.0)), ("hinge", bank.ramp(2.5, 20.0)))
        for estimator in some
        for repeats in (16, 64)
    ]


def design_cells():
    """Return cells of three costs of three variables with every estimator and design; across a jump, those without gradients."""
    axes, slanted = list(np.eye(3)), np.full(3, 3**-0.5)
    line = bank.power(1)
    scenes = {
        "wave": bank.Ridge([bank.wave(1.0)] * 3, axes, np.full(3, 0.3), 0.2),
        "kink": bank.Ridge([line, bank.ramp(0.5, 5.0)], [axes[0], slanted], np.zeros(3), 1.0),
        "jump": bank.Ridge([line, bank.step(0.5, 2.0)], [axes[0], slanted], np.zeros(3), 1.0, says=False),
    }
    every = [
        registry.make("estimators", name, design)
        for name in sorted(registry.entries()["estimators"])
        for design in DESIGNS.values()
    ]
    return [
        Cell(cost, scene, estimator, 16, 32)
        for cost, scene in scenes.items()
        for estimator in every
        if can_run(estimator, Numpy().compile(compose(scene)), 32)
        and not (cost == "jump" and "grad" in estimator.needs)
    ]


def can_run(estimator, problem, samples):
    """Return whether an estimator can use its design on a problem."""
    try:
        estimator.design(problem.program, samples)
    except Unsupported:
        return False
    return not estimator.refusal(problem.program, problem.provides, "numpy")


def is_mean(estimator):
    """Return whether an estimate is the mean of one independent term per sample."""
    is_independent = estimator.draws == "iid" and not estimator.mirrored
    return is_independent and isinstance(estimator, SampleMean) and estimator.separable


def drawn(cell, problem, repeats, *seed):
    """Return noise ``(repeats, N, d)`` of the estimator's design, which cells with the same seed share."""
    return kept(cell.estimator.design(problem.program, cell.samples), seed, (repeats, cell.samples, problem.dim))


@lru_cache(maxsize=16)
def kept(design, seed, shape):
    """Return the noise of :func:`drawn`: Sobol sets take most of the time of the program."""
    draw = np.random.default_rng(seed)
    if design == IID:
        return draw.standard_normal(shape)
    return np.stack([samples_of(draw, *shape[1:], design) for _ in range(shape[0])])


def moments(cell, problem):
    """Return the mean of an estimate ``(d,)`` and the trace of its covariance."""
    theta, d = cell.scene.start, cell.scene.start.size
    if not is_mean(cell.estimator):
        blocks = np.split(drawn(cell, problem, PRECISE // cell.samples, 8, d, len(cell.cost)), PRECISE // PART)
        many = np.concatenate([cell.estimator.estimate(problem, theta, block) for block in blocks])
        return many.mean(axis=0), float(many.var(axis=0).sum())
    if isinstance(cell.estimator, Fobg):
        problem = Numpy().compile(compose(cell.smooth))  # a difference across a jump is not a derivative
    draw = np.random.default_rng([8, d, len(cell.cost)])
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
    return centre + mean / weight, (square / weight - float(mean @ mean) / weight**2) / cell.samples


def covered(cell, sets):
    """Return a table of the sets: whether each interval contains the true value, and whether the row has no remark."""
    problem, theta, method = Numpy().compile(compose(cell.scene)), cell.scene.start, cell.estimator
    truth, is_unbiased = Truth.exact(cell.scene.truth()), method.declares_unbiased(problem.program)
    mean, variance = moments(cell, problem)
    # a scene may not declare its jumps, whose slopes first order misses
    misses = isinstance(method, Fobg) and any("step" in piece.name for piece in cell.scene.pieces)
    bias = float(np.linalg.norm(mean - truth.mean)) if misses or not is_unbiased else 0.0
    slack = ROUNDING * (1.0 + truth.norm)
    known = (bias, variance, variance * cell.samples, math.sqrt(variance + bias**2) / truth.norm)
    # terms that differ only by the rounding of a difference have variance 0
    rounding = np.array([slack, slack**2, slack**2 * cell.samples, slack])
    rows = []
    seed = 7, theta.size, cell.repeats, cell.samples, len(cell.cost)
    for noise in np.split(drawn(cell, problem, sets * cell.repeats, *seed), sets):
        sums, diagnostics = None, None
        if is_mean(method):
            terms = per_repeat(method.terms(problem, theta, columns(noise)), noise)
            estimates, rest = terms.mean(axis=1), terms - terms[0].mean(axis=0)
            sums = rest.sum(axis=1), np.einsum("rnd,rnd->r", rest, rest)
        else:
            estimates, diagnostics = method.estimate_with_diagnostics(problem, theta, noise)
        is_random = method.draws_noise(problem.program)
        found = summarise(estimates, truth, cell.samples, sums, is_unbiased, is_random)
        doubt = method.remark(json.loads(summarise_diagnostics([diagnostics]))) if diagnostics else ""
        low, high = np.transpose(
            [(getattr(found, f"{name}_low"), getattr(found, f"{name}_high")) for name in STATISTICS[:3]]
            + [rmse_interval(pd.Series(found.__dict__))]
        )
        rows.append([*((low <= known + rounding) & (known <= high + rounding)), not (found.note or doubt)])
    design = "mirrored" if method.mirrored else method.draws
    return pd.DataFrame(rows, columns=[*STATISTICS, "plain"]).assign(
        cost=cell.cost,
        estimator=label(replace(method, draws="iid", mirrored=False)),
        design=design,
        repeats=cell.repeats,
        is_biased=bias > 0.0,
    )


def main(sets=20, stride=0):
    """Print the coverage; return 1 unless that of sets without remark on the bank is within 91% to 99%."""
    chosen = [(cell, sets) for cell in bank_cells()[:: stride or 1]]
    chosen += [] if stride else [(cell, 10 * sets) for cell in (*tail_cells(), *design_cells())]
    table = pd.concat((covered(*each) for each in chosen), ignore_index=True)
    bank_rows = table["cost"] == "bank"
    table.loc[bank_rows, ["repeats", "design"]] = 0, ""
    table.loc[bank_rows, "estimator"] = table["estimator"].str.partition("[")[0]
    names = list(STATISTICS)
    shares = table.groupby(["cost", "estimator", "repeats", "design"])[[*names, "plain"]].mean().mul(100)
    print(shares.drop(["wave", "kink", "jump"], errors="ignore").to_csv(sep="|", float_format="%.1f"))
    lowest = shares.drop(["bank", "exp(x)", "hinge"], errors="ignore").groupby(["estimator", "design"]).min().round()
    print(lowest.unstack().to_csv(sep="|"))
    plain = table[bank_rows & table["plain"]]
    print(f"{len(plain)} of {bank_rows.sum()} sets of the bank without remark: {plain[names].mean().to_dict()}")
    print(f"bias of those with a bias: {plain.loc[plain['is_biased'], 'bias'].mean():.1%}")
    return int(not plain[names[:3]].mean().between(LEAST, MOST).all())


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in sys.argv[1:3])))
