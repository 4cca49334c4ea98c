"""Statistics against closed forms, and the coverage of their intervals."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from bench.measure.statistics import Sampling, Summary, Truth, bias_interval, heavy_tails, summarise, variance_interval
from bench.report.views import rmse_interval

# ---------------------------------------------------------------------------------------------- closed forms


def moments(estimates, truth):
    """Squared distance of the mean from the truth, and trace of the covariance of one estimate, the long way."""
    difference = estimates.mean(axis=0) - truth
    return float(difference @ difference), float(np.trace(np.atleast_2d(np.cov(estimates.T, ddof=1))))


def with_covariance(mean, covariance):
    """A truth whose error has a diagonal covariance."""
    return Truth(mean, Sampling(np.sqrt(covariance), math.inf))


@pytest.mark.parametrize("dim", [1, 3, 40])
@pytest.mark.parametrize("repeats", [2, 5, 64])
def test_columns_are_their_formulas(dim, repeats):
    rng = np.random.default_rng(1)
    reference = rng.standard_normal(dim)
    estimates = reference + 3.0 + rng.standard_normal((repeats, dim))
    covariance = np.diag(rng.uniform(0.01, 0.02, dim))
    summary = summarise(estimates, with_covariance(reference, covariance), samples=7)
    squared, trace = moments(estimates, reference)
    error = np.trace(covariance)
    assert summary.grad_norm == pytest.approx(np.linalg.norm(estimates.mean(axis=0)))
    assert summary.reference_norm == pytest.approx(np.linalg.norm(reference))
    assert summary.reference_se == pytest.approx(math.sqrt(error))
    assert summary.variance == pytest.approx(trace)
    assert summary.variance_per_sample == pytest.approx(7 * trace)
    assert summary.bias == pytest.approx(math.sqrt(max(0.0, squared - trace / repeats - error)))
    assert summary.bias_rel == pytest.approx(summary.bias / summary.reference_norm)
    mean_square = ((estimates - reference) ** 2).sum(axis=1).mean()
    assert summary.rmse == pytest.approx(math.sqrt(mean_square - error))
    assert summary.rmse_rel == pytest.approx(summary.rmse / summary.reference_norm)
    lengths = np.linalg.norm(estimates, axis=1) * np.linalg.norm(reference)
    assert summary.cosine == pytest.approx((estimates @ reference / lengths).mean())
    assert summary.sign_agreement == pytest.approx((np.sign(estimates) == np.sign(reference)).mean())
    assert summary.finite_fraction == 1.0
    assert 0.0 <= summary.bias_low <= summary.bias <= summary.bias_high
    assert summary.variance_low <= summary.variance <= summary.variance_high


def test_an_rmse_is_at_least_the_standard_deviation_also_where_the_reference_errs_more():
    """The squared distance less the reference's own error may be negative: it was cut at 0, outside the interval."""
    rng, found = np.random.default_rng(12), []
    for _ in range(50):
        batches = 1.0 + 3.0 * rng.standard_normal((8, 2))
        one = summarise(1.0 + 0.1 * rng.standard_normal((16, 2)), Truth.from_batches(batches), 4)
        found.append(dataclasses.asdict(one))
    rows = pd.DataFrame(found)
    low, high = rmse_interval(rows)
    assert (rows["bias"] == 0.0).sum() > 10
    assert (rows["rmse"] >= (1.0 - 1e-12) * np.sqrt(rows["variance"])).all()
    assert ((low * rows["reference_norm"] <= rows["rmse"]) & (rows["rmse"] <= high * rows["reference_norm"])).all()


@pytest.mark.parametrize("noise", ["normal", "lognormal"])
def test_trace_of_the_squared_covariance_is_unbiased_under_any_noise(noise):
    rng = np.random.default_rng(5)
    repeats, dim, trials = 8, 20, 3000
    scale = np.geomspace(1.0, 0.1, dim)
    draw = rng.standard_normal if noise == "normal" else lambda shape: rng.lognormal(0.0, 0.5, shape)
    spread = 1.0 if noise == "normal" else (math.exp(0.25) - 1.0) * math.exp(0.25)
    expected = float((spread**2 * scale**4).sum()) / repeats**2
    raw, corrected = [], []
    for sample in draw((trials, repeats, dim)) * scale:
        sampling = Sampling.of(sample)
        square = float(((sampling.rows @ sampling.rows.T) ** 2).sum())
        raw.append(square)
        corrected.append(square - sampling.excess())
    error = np.std(corrected) / math.sqrt(trials)
    # The floor (tr C)^2 / d moves the mean up a little where the estimate falls below it.
    assert abs(np.mean(corrected) - expected) < 4 * error + 0.02 * expected
    assert np.mean(raw) > 1.5 * expected


@pytest.mark.parametrize(("repeats", "batches"), [(5, 8), (8, 5)])
def test_interval_of_two_error_sources_has_welchs_degrees(repeats, batches):
    # Far from zero, in one dimension, the ends are |m| -+ t se with Welch's degrees of freedom.
    from scipy.special import stdtrit

    rng = np.random.default_rng(21)
    estimates, reference = 3.0 * rng.standard_normal((repeats, 1)) + 500.0, rng.standard_normal((batches, 1)) + 100.0
    one, other = (float(np.var(sample, ddof=1)) / len(sample) for sample in (estimates, reference))
    error = math.sqrt(one + other)
    degrees = (one + other) ** 2 / (one**2 / (repeats - 1) + other**2 / (batches - 1))
    quantile = float(stdtrit(degrees, 0.975))
    assert quantile > 1.1 * 1.96
    distance = float(estimates.mean() - reference.mean())
    summary = summarise(estimates, Truth.from_batches(reference), 1)
    # Sankaran's form errs by less than a hundredth of a standard error here.
    assert summary.bias_low == pytest.approx(distance - quantile * error, abs=0.02 * error)
    assert summary.bias_high == pytest.approx(distance + quantile * error, abs=0.02 * error)
    assert summary.bias_rel == pytest.approx(summary.bias / abs(float(reference.mean())))
    assert summary.rmse_rel == pytest.approx(summary.rmse / abs(float(reference.mean())))


def test_unit_of_the_gradient_does_not_matter():
    rng = np.random.default_rng(9)
    estimates, batches = rng.standard_normal((16, 3)) + 1.0, rng.standard_normal((8, 3)) * 0.1
    one = summarise(estimates, Truth.from_batches(batches), 4)
    for unit in (1e-140, 1e140):
        other = summarise(estimates * unit, Truth.from_batches(batches * unit), 4)
        for field in ("bias", "bias_low", "bias_high", "rmse", "grad_norm", "reference_se"):
            assert getattr(other, field) == pytest.approx(getattr(one, field) * unit, rel=1e-9)
        assert other.variance == pytest.approx(one.variance * unit**2, rel=1e-9)
        assert (other.cosine, other.note) == (pytest.approx(one.cosine), one.note)


# ---------------------------------------------------------------------------------------------------- edges


NAN, RARE = math.nan, 3 / (64 * 256)
SPIKE = np.where(np.arange(64) == 5, 3.0, 0.0)[:, None] * np.ones(2)
CENTRED = np.random.default_rng(11).standard_normal((16, 2))
ROUNDED = np.array([0.1, -7.0, 3.0]) * np.where(np.arange(12) % 2, 1 + 3e-16, 1 + 1e-16)[:, None]
EDGES = {
    # first-order gradients of a step: 0 every time; of the 256 samples of an estimate a share of 3 / (64 * 256) may be off
    "step": (
        np.zeros((64, 1)),
        [3.98942],
        256,
        dict(
            variance=0,
            variance_low=0,
            variance_high=RARE * 3.98942**2 / 256,
            variance_per_sample_high=RARE * 3.98942**2,
            bias=3.98942,
            bias_low=3.98942 * (1 - RARE),
            bias_high=3.98942 * (1 + RARE),
            cosine=0,
            sign_agreement=0,
        ),
        f"identical: the intervals allow for an event of the gradient's size, rarer than about {RARE:.2g} per sample",
    ),
    # the rule of three leaves 3 / (12 * 3) = 8% of the gradient
    "rounding": (ROUNDED, [0.1, -7.0, 3.0], 3, dict(variance=0, bias_low=0), "identical"),
    "7% off": (ROUNDED * 1.07, [0.1, -7.0, 3.0], 3, dict(bias_low=0), "identical"),
    "zero": (np.zeros((4, 2)), [0, 0], 10, dict(bias=0, bias_low=0, bias_high=0, rmse=0, variance=0), "identical"),
    "zero reference": (CENTRED, [0, 0], 1, dict(bias_rel=NAN, rmse_rel=NAN, cosine=NAN, sign_agreement=NAN), ""),
    "one repeat": (
        np.array([[1.0, 2.0]]),
        [1, 0],
        1,
        dict(variance=NAN, bias=NAN, bias_high=NAN, rmse=NAN),
        "1 repeat",
    ),
    "one that differs": (SPIKE, [1, 1], 1, dict(variance_low=0, variance_high=math.inf), "heavy tails"),
    # only the first coordinate has a sign to agree with
    "directions": (
        np.array([[1.0, 1, 5], [-1, 0, 0], [0, 0, 0], [2, 0, 0]]),
        [1, 0, 0],
        1,
        dict(cosine=(1 / math.sqrt(27) - 1 + 0 + 1) / 4, sign_agreement=0.5),
        "only 4 repeats",
    ),
    **{
        f"{bad}": (
            np.where(np.arange(16).reshape(8, 2) == 7, bad, 1.0),
            [3, 4],
            1,
            {f.name: NAN for f in dataclasses.fields(Summary) if f.name != "note"}
            | dict(reference_norm=5, reference_se=0, finite_fraction=7 / 8),
            "1 of 8 estimates are not finite",
        )
        for bad in (math.nan, math.inf, -math.inf)
    },
}


@pytest.mark.parametrize("edge", EDGES)
def test_edges(edge):
    estimates, truth, samples, fields, words = EDGES[edge]
    summary = summarise(estimates, Truth.exact(np.array(truth, dtype=float)), samples)
    assert {name: getattr(summary, name) for name in fields} == pytest.approx(fields, nan_ok=True)
    assert words in summary.note


def test_identical_estimates_that_depend_on_no_draw_allow_for_no_rare_event():
    batches = np.random.default_rng(10).standard_normal((30, 2)) + 0.5  # entries below 1, so that no rounding differs
    truth = Truth.from_batches(batches)
    summary = summarise(np.ones((20, 2)), truth, 5, is_random=False)
    assert (summary.variance, summary.variance_high) == (0.0, 0.0)
    assert "identical" not in summary.note
    # the summary computes in units of the largest entry, which moves the last digits
    assert summary.bias_high == pytest.approx(bias_interval(np.ones(2) - truth.mean, *truth.errors)[2], rel=1e-12)
    drawn = summarise(np.ones((20, 2)), truth, 5)
    assert drawn.bias_high > summary.bias_high > truth.standard_error
    assert "identical" in drawn.note
    exact = summarise(np.ones((20, 2)), Truth.exact(np.array([1.0, 2.0])), 5, is_random=False)
    assert (exact.bias, exact.bias_low, exact.bias_high) == (1.0, 1.0, 1.0)


def test_differing_estimates_have_intervals_whatever_their_estimator_declares():
    truth = Truth.exact(np.ones(2))
    assert summarise(CENTRED, truth, 5, is_random=False) == summarise(CENTRED, truth, 5)


def test_a_bias_above_the_rule_of_three_is_one():
    assert summarise(ROUNDED * 1.1, Truth.exact(ROUNDED[1]), 3).bias_low > 0


@pytest.mark.parametrize("repeats", [2, 3, 4])
@pytest.mark.parametrize("dim", [1, 2, 50])
def test_few_repeats_give_wide_intervals_and_say_so(repeats, dim):
    rng = np.random.default_rng(12)
    inside = 0
    for _ in range(100):
        summary = summarise(rng.standard_normal((repeats, dim)) + 0.5, Truth.exact(np.zeros(dim)), 1)
        inside += summary.bias_low <= 0.5 * math.sqrt(dim) <= summary.bias_high
        assert "repeats" in summary.note
        assert summary.variance_low <= summary.variance <= summary.variance_high
    assert inside >= 85


@pytest.mark.parametrize("ratio", [1e3, 1e6, 1e9, 1e12])
def test_bias_far_above_the_noise(ratio):
    noise = np.random.default_rng(14).standard_normal((32, 3))
    error = math.sqrt(Sampling.of(noise).trace)
    _, low, high = bias_interval(np.array([ratio * error, 0.0, 0.0]), Sampling.of(noise))
    assert low < ratio * error < high
    # Along one of three equal axes: about 2 * 2.04 errors of that axis, known to 1 / sqrt(62) = 13%.
    assert (high - low) / error == pytest.approx(4.08 / math.sqrt(3), rel=0.6)


def test_lucky_draw_does_not_claim_more_than_the_noise_allows():
    errors = Sampling.of(np.random.default_rng(15).standard_normal((64, 50)))
    bias, low, high = bias_interval(np.zeros(50), errors)
    assert (bias, low) == (0.0, 0.0)
    # At T = tr S, equal noise along 50 axes leaves room for |b|^2 = 1.96 sqrt(2 / 50 + 4 |b|^2 / 50) tr S.
    assert high / math.sqrt(errors.trace) == pytest.approx(0.758, rel=0.1)


def test_heavy_tails_are_remarked_on_and_ordinary_ones_are_not():
    rng = np.random.default_rng(16)
    truth = Truth.exact(np.zeros(3))
    remarks = [summarise(rng.standard_normal((64, 3)), truth, 1).note for _ in range(500)]
    assert not any(remarks)
    remarks = [summarise(rng.standard_normal((16, 1)), Truth.exact(np.zeros(1)), 1).note for _ in range(500)]
    assert sum("heavy tails" in remark for remark in remarks) <= 25
    spike = rng.standard_normal((64, 3))
    spike[7] *= 1e3
    assert "heavy tails: one repeat of 64 has 98%" in summarise(spike, truth, 1).note
    along = rng.standard_normal((64, 3))
    along[:, 2] = 0.0
    along[7, 2] = 4.0
    assert "along the bias" in summarise(along + np.array([0.0, 0.0, 50.0]), truth, 1).note


@pytest.mark.parametrize(("share", "least", "most"), [(0.5, 0.5, 0.9), (0.3, 0.0, 0.0)])
def test_terms_of_two_values_at_equal_distances_are_a_remark(share, least, most):
    """The variance p (1 - p) is largest at p = 1/2, so that it hardly depends on the number of each value there."""
    rng, missed, remarks = np.random.default_rng(3), [], 0
    for _ in range(200):
        terms = (rng.random((16, 16, 1)) < share) - 0.5
        sums = terms.sum(axis=1), (terms**2).sum(axis=(1, 2))
        summary = summarise(terms.mean(axis=1), Truth.exact(np.ones(1)), 16, sums)
        low, high = summary.variance_per_sample_low, summary.variance_per_sample_high
        if "equally far" in summary.note:
            remarks += 1
        else:
            missed.append(not low <= share * (1.0 - share) <= high)
    assert least <= remarks / 200 <= most
    assert np.mean(missed) < 0.1


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: summarise(np.zeros((4, 2)), Truth.exact(np.zeros(3)), 1), r"\(R, 3\).*given \(4, 2\)"),
        (lambda: summarise(np.zeros((0, 3)), Truth.exact(np.zeros(3)), 1), r"given \(0, 3\)"),
        (lambda: summarise(np.zeros((4, 3)), Truth.exact(np.zeros(3)), 0), "given 0"),
        (lambda: Truth.exact(np.array([1.0, np.nan])), "not finite"),
    ],
)
def test_bad_input_is_refused_with_the_shapes(call, words):
    with pytest.raises(ValueError, match=words):
        call()


# -------------------------------------------------------------------------------------------------- coverage


def draw(rng, noise, shape):
    """Noise of variance 1 in every coordinate."""
    return rng.standard_normal(shape) if noise == "normal" else rng.standard_t(5, shape) / math.sqrt(5 / 3)


@pytest.mark.parametrize("biased", [False, True], ids=["no bias", "bias"])
@pytest.mark.parametrize("noise", ["normal", pytest.param("t5", marks=pytest.mark.slow)])
def test_bias_interval_is_calibrated(noise, biased):
    """A bias of several sizes and directions, exact and sampled references; the share covered is known to 0.9 points."""
    rng, cells, inside = np.random.default_rng(17), 600, 0
    for _ in range(cells):
        dim, repeats, is_sampled = rng.choice([1, 2, 3, 5, 10, 30, 100]), rng.choice([16, 32, 64]), rng.integers(2)
        spread = np.sqrt(
            [np.ones(dim), np.geomspace(1.0, 1e-4, dim), np.r_[1.0, np.full(dim - 1, 1e-4)]][rng.integers(3)]
        )
        error = math.sqrt((spread**2).sum() / repeats * (1.25 if is_sampled else 1.0))
        size = error * rng.uniform(0.5, 10.0) if biased else 0.0
        along = [np.eye(dim)[0], np.eye(dim)[-1], np.full(dim, 1 / math.sqrt(dim))][rng.integers(3)]
        batches = draw(rng, noise, (32, dim)) * spread * math.sqrt(8 / repeats)
        truth = Truth.from_batches(batches) if is_sampled else Truth.exact(np.zeros(dim))
        summary = summarise(draw(rng, noise, (repeats, dim)) * spread + size * along, truth, 1)
        inside += summary.bias_low <= size <= summary.bias_high
    assert 0.91 <= inside / cells <= 0.99


def test_ends_are_quantiles_of_the_chi_square_with_the_moments_of_the_square():
    """The documented g, nu and q by hand, for a known covariance that is far from round."""
    m, covariance = np.array([3.0, 0.4, -0.2]), np.diag([1.0, 0.3, 0.01])
    _, low, high = bias_interval(m, *with_covariance(m, covariance).errors)
    trace, square, total = np.trace(covariance), np.trace(covariance @ covariance), m @ m
    once, twice = m @ covariance @ m, m @ covariance @ covariance @ m

    def chance(beta):
        q = min(max(once - square + twice / once * (beta**2 - total + trace), 0.0), trace * beta**2)
        g = (square + 2.0 * q) / (trace + 2.0 * beta**2)
        return float(scipy.stats.ncx2.cdf(total / g, trace / g, beta**2 / g))

    # Sankaran's transform is good to a thousandth here
    assert chance(low) == pytest.approx(0.975, abs=1e-3)
    assert chance(high) == pytest.approx(0.025, abs=1e-3)


@pytest.mark.parametrize(("largest", "heavy"), [(30.0, True), (20.0, True), (18.0, False), (1.0, False)])
def test_tails_are_heavy_below_three_quarters_of_the_root_of_the_repeats(largest, heavy):
    """Sixteen repeats of which one has a square of ``largest``: (sum y)^2 / sum y^2 is 2.2, 2.95, 3.2 and 16."""
    deviations = np.sqrt(np.array([largest, *[1.0] * 15]))[:, None]
    share = largest / (largest + 15.0)
    assert heavy_tails(deviations) == pytest.approx(share if heavy else 0.0)


def test_upper_end_of_a_variance_is_that_of_hall():
    """Pseudo-values by leaving out, one at a time; T is where Hall's cubic has Student's quantile."""
    x = np.array([0.1, -0.3, 0.5, 0.2, 4.0, -0.6, 0.0, 0.3])[:, None]
    repeats = len(x)
    whole = math.log(x.var(ddof=1))
    pseudo = np.array([repeats * whole - (repeats - 1) * math.log(np.delete(x, r).var(ddof=1)) for r in range(repeats)])
    low, high = variance_interval(x - x.mean(axis=0))
    centre, spread = pseudo.mean(), pseudo.std(ddof=1)
    g = float(scipy.stats.skew(pseudo, bias=False))
    quantile = scipy.stats.t.ppf(0.975, repeats - 1) / math.sqrt(repeats)
    t = (centre - math.log(high)) / spread
    assert t + g * t**2 / 3 + g**2 * t**3 / 27 + g / (6 * repeats) == pytest.approx(-quantile, rel=1e-9)
    assert math.log(low) == pytest.approx(centre - quantile * spread, rel=1e-9)
    assert math.log(high) > centre + 1.5 * quantile * spread


def test_an_error_without_direction_is_that_of_equal_rows():
    draw = np.random.default_rng(0)
    sample, error = draw.standard_normal((6, 40)), 0.7
    difference = sample.mean(axis=0) + 0.1
    rows, hidden = Sampling(np.eye(40) * error / math.sqrt(40), math.inf), Sampling.without_direction(error, 40)
    both = [bias_interval(difference, Sampling.of(sample), one) for one in (rows, hidden)]
    assert both[0] == pytest.approx(both[1], rel=1e-12)
    by_rows, exact = Truth(difference, rows), Truth.exact(difference, error)
    assert by_rows.over(3.0).standard_error == pytest.approx(exact.over(3.0).standard_error, rel=1e-12)
    assert by_rows.vanishes() == exact.vanishes()
