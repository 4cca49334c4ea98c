"""Certified references: against closed forms that they do not see, and how they draw, stop, and act on their checks."""

import itertools
import math
import re
from types import SimpleNamespace

import bank
import numpy as np
import pytest
from classes import Heaviside, Numpy

from bench.measure import noise, reference
from bench.measure.batches import in_columns
from bench.measure.jumps import largest_jump
from bench.measure.quadrature import Integral
from bench.measure.reference import BATCHES, certify
from bench.model import compose

EVERY = bank.cases()
SAMPLES = 1 << 14
"""Of the fast subset: enough for 64 batches of 256."""
LISTED = 1e-9
"""Relative error of quadrature between breakpoints where they are, against 1e-5 where they are elsewhere."""


def ridge(*pieces, dim=3, sigma=0.5, **given):
    """A case along the first axis."""
    scene = bank.Ridge(
        [bank.scaled(p, sigma) for p in pieces], [np.eye(dim)[0]] * len(pieces), np.zeros(dim), sigma, **given
    )
    return bank.Case("ridge", compose(scene), scene.truth())


def found_at(found, name):
    """A number in the method's text."""
    return float(re.search(rf"{name}=([-\d.e]+)", found.method).group(1))


# ------------------------------------------------------------------------------------------------ against truths


@pytest.mark.parametrize("case", EVERY[::8], ids=lambda case: case.label[:50])
def test_reference_is_within_what_it_states(case):
    assert bank.excess(case, bank.certified(case, SAMPLES)) <= 1.0


@pytest.mark.parametrize("stride", [pytest.param(4, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.full)])
def test_bank_is_held(stride, monkeypatch):
    """Of over 200 references 99% are within what they state, and none is beyond three times that."""
    assert len(EVERY) >= 200
    monkeypatch.setattr(bank, "cases", lambda: EVERY[::stride])
    assert bank.main() == 0


def test_listed_breakpoints_are_panel_edges():
    case = ridge(bank.step(0.3, 1.0), dim=1, sigma=0.2, says=False, listed=((0.06,),))
    found = bank.certified(case, SAMPLES)
    assert found.gradient == pytest.approx(case.truth, rel=LISTED)
    assert found.error < LISTED * abs(case.truth[0])
    elsewhere = ridge(bank.step(0.3, 1.0), dim=1, sigma=0.2, says=False, listed=((0.07,),))
    assert bank.certified(elsewhere, SAMPLES).error > LISTED


@pytest.mark.parametrize(
    ("pieces", "dim", "least", "most", "words"),
    [
        ([bank.power(1, 0.2), bank.bump(2.82, 1.8e-4, 3.0 / 1.8e-4)], 1, 0.0, 1e-9, ""),
        ([bank.power(1, 0.2), bank.bump(2.0, 3e-5, 1e5)], 1, 0.0, 2e-8, ""),
        ([bank.bump(1.3, 1e-5, 1.0)], 1, 0.0, 1e-9, ""),
        ([bank.Piece("far", lambda u: 1e6 + u, lambda u, s: 1.0)], 1, 1e-10, 1e-6, ""),
        ([bank.Piece("pole", lambda u: np.abs(u - 0.5) ** -0.9, lambda u, s: 3.2071)], 1, 0.0, 1.0, "1 / distance^0.9"),
        ([bank.wave(1.0), bank.power(1, -np.exp(-0.5) + 1e-9), bank.power(2)], 2, 0.0, 1e-9, ""),
        ([bank.power(1, 0.2), bank.bump(2.0, 1e-4, 3e4)], 2, 0.0, 10.0, "narrower than the spacing"),
    ],
    ids=[
        "spike",
        "narrow spike",
        "nothing but a spike",
        "rounding of 1e6",
        "pole",
        "effects that cancel",
        "ridge between points",
    ],
)
def test_quadrature_states_an_error_that_holds(pieces, dim, least, most, words):
    """No sample meets a spike; two halvings of equal panels show a fourteenth of the error at a pole.

    Nothing but a spike was a pole: its halvings went on down to rounding, which falls no further.
    """
    case = ridge(*pieces, dim=dim, sigma=1.0)
    found = bank.certified(case, SAMPLES)
    assert found.method.startswith("quadrature")
    assert bank.excess(case, found) <= 1.0
    assert least <= found.error < most
    assert words in found.note
    notes = [note for note in found.note.split("; ") if note and "standard deviations apart" not in note]
    assert bool(words) == bool(notes)


def test_what_the_points_of_a_plane_miss_is_below_the_width_that_remarks_state():
    """A spike 5e-4 wide between points .045 apart moves the gradient by 2.3 times its size."""
    spot = np.array([[1.4], [0.7]])
    spike = bank.Piece(
        "spike", lambda u: 4e6 * np.exp(-((u - spot) ** 2).sum(axis=0) / (2 * 5e-4**2)), lambda u, s: 0.0
    )
    found = bank.certified(
        bank.Case(
            "", compose(bank.Ridge([bank.power(1, 0.2), spike], [np.eye(2)[0], np.eye(2)], np.zeros(2), 1.0)), 0.0
        ),
        SAMPLES * 4,
    )
    assert found.gradient == pytest.approx([0.2, 0.0], abs=1e-9)
    assert f"points are {found.spacing:.2g} standard deviations apart and may miss a narrower feature" in found.note
    assert "narrower" not in bank.certified(ridge(bank.power(1), dim=1), SAMPLES).note


@pytest.mark.parametrize(("dim", "least"), [(1, 1 << 15), (2, 1 << 17)])
def test_rules_that_agree_at_once_are_still_refined(dim, least):
    assert found_at(bank.certified(ridge(bank.power(1), dim=dim), SAMPLES), "points") >= least


def test_certificate_of_an_assumed_fact_states_what_its_check_resolves():
    along = [np.eye(3)[0]]
    assumed, declared = (
        bank.certified(bank.Case("line", compose(scene), np.eye(3)[0]), 1 << 16)
        for scene in (
            bank.Undeclared([bank.power(1), bank.power(2, 0.1)], along * 2, np.zeros(3), 1.0),
            bank.Ridge([bank.power(1), bank.power(2, 0.1)], along * 2, np.zeros(3), 1.0),
        )
    )
    assert "assumed_continuous" in assumed.method
    assert "assumed_continuous" not in declared.method
    assert assumed.error >= found_at(assumed, "check_resolves") * 0.99
    assert declared.error < 0.01 * assumed.error


@pytest.mark.parametrize(
    ("cost", "dim", "is_finite", "words"),
    [
        (lambda u: np.exp(0.5 * u**2), 1, False, "may not exist"),
        (lambda u: np.exp(0.55 * u**2), 1, False, "may not exist"),
        (lambda u: 1.0 / (u - 4.0), 1, False, "may not exist"),
        (lambda u: np.abs(u - 4.0) ** -0.5, 1, True, ""),
        *((lambda u: np.sqrt(2.5 - u), dim, False, "not finite") for dim in (1, 2, 3)),
        (lambda u: np.where(u > 0, np.nan, u), 3, False, "not finite"),
        (lambda u: u + np.exp(np.exp(np.minimum(u - 7.0, 7.0))), 3, True, "may not exist"),
        (lambda u: u + 1e280 * np.maximum(u - 9.0, 0.0), 3, False, "may not exist"),
        (lambda u: 1.0 * (u > 6.0), 5, True, "not seen"),
    ],
)
def test_mean_that_is_in_doubt_is_a_remark(cost, dim, is_finite, words):
    """exp(a u^2) has a mean below a = 1/2 only; exp(exp(u - 7)) overflows at 13.6 deviations."""
    with np.errstate(all="ignore"):
        found = bank.certified(ridge(bank.Piece("", cost, lambda u, s: math.nan), dim=dim, sigma=1.0), SAMPLES)
    assert found.is_finite == is_finite
    assert words in found.note
    notes = [note for note in found.note.split("; ") if note and "standard deviations apart" not in note]
    assert bool(words) == bool(notes)
    # without what diverges: E exp(exp(u - 7)) u is .0023
    assert not is_finite or found.known().standard_error < 0.1


def test_huge_and_tiny_costs_have_references():
    for factor, dim in itertools.product((1e200, 1e-200), (1, 3)):
        case = ridge(bank.power(1, factor), bank.power(2, 0.3 * factor), dim=dim)
        found = bank.certified(case, SAMPLES)
        plain = bank.certified(ridge(bank.power(1), bank.power(2, 0.3), dim=dim), SAMPLES)
        assert found.gradient / factor == pytest.approx(plain.gradient, rel=1e-7)
        assert 0.0 < found.known().standard_error / factor < 0.1


# ------------------------------------------------------------------------------------------------- what is drawn


@pytest.fixture
def drawn(monkeypatch):
    """Every draw of noise: (stream, block, count)."""
    seen = []
    plain = noise.draw

    def draw(*given):
        seen.append((given[5], given[0], given[3]))
        return plain(*given)

    monkeypatch.setattr(noise, "draw", draw)
    monkeypatch.setattr(noise, "_kept", {})
    return seen


def test_no_noise_is_drawn_twice_and_none_is_that_of_cells(drawn):
    found = bank.certified(ridge(bank.power(3)), 1 << 16)
    streams = {stream for stream, *_ in drawn}
    assert {"pilot", "reference", "check", "tails"} <= streams
    assert "cells" not in streams
    blocks = [(stream, block) for stream, block, _ in drawn if stream != "tails"]
    assert len(blocks) == len(set(blocks))
    # as many samples as it says, and more than one block of them
    counts = [count for stream, _, count in drawn if stream == "reference"]
    assert sum(counts) == found_at(found, "n") == 1 << 16
    assert len(counts) > 2
    assert sum(count for stream, _, count in drawn if stream == "check") == 1 << 14


def test_batches_are_independent_means_of_all_samples(drawn):
    """The reference of a cubic cost is the mean of its own draws, batch by batch."""
    case = ridge(bank.power(3), dim=4, sigma=0.5)
    found = bank.certified(case, 1 << 14)
    assert "first_order" in found.method
    total, count = np.zeros((BATCHES, 4)), 0
    for stream, block, size in list(drawn):
        if stream == "reference":
            w = noise.draw(block, "ridge", 1, size, 4, stream)[0].T
            terms = np.zeros_like(w)
            terms[0] = 3 * w[0] ** 2 / 0.5  # d/dx (x / sigma)^3 at x = sigma w
            total += terms.reshape(4, BATCHES, -1).sum(axis=2).T
            count += size // BATCHES
    assert found.batches == pytest.approx(total / count, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("tolerance", [0.5, 0.02, 0.005])
def test_sampling_stops_at_its_tolerance_and_not_before(tolerance):
    case = ridge(bank.power(1), bank.power(2, 0.5))
    problem = Numpy().compile(case.program)
    found = certify(problem, Numpy.provides, 1 << 20, tolerance)
    n, norm = found_at(found, "n"), np.linalg.norm(found.gradient)
    assert found.known().standard_error <= tolerance * norm
    assert n < 1 << 20
    # half as many would not do, unless it was the least number
    assert n == reference.LEAST_SAMPLES or found.known().standard_error * 2**0.5 > 0.9 * tolerance * norm


def test_parts_of_one_length_give_the_whole():
    sizes = []

    def double(w):
        sizes.append(w.shape[1])
        return 2 * w

    w = np.arange(22.0).reshape(2, 11)
    assert np.array_equal(in_columns(double, w, 4), 2 * w)
    assert sizes == [4, 4, 4]


# --------------------------------------------------------------------------------------------- checks acted upon


def test_small_spread_alone_certifies_nothing():
    """An event 3 sigma away: a pilot that missed it would stop at once, with a standard error of 0."""
    case = ridge(bank.power(1), bank.ramp(3.0, 33.0), dim=4)
    found = bank.certified(case, 1 << 18)
    assert found_at(found, "n") >= reference.LEAST_SAMPLES
    assert found.known().standard_error > 0.0
    assert bank.excess(case, found) <= 1.0


def test_tails_that_samples_do_not_show_are_part_of_the_error():
    """4.2 sigma away, 1e-5 of samples: of 16384 none or one; far tails along each coordinate are looked at."""
    case = ridge(bank.power(1), bank.ramp(4.2, 2000.0), dim=3)
    found = bank.certified(case, 1 << 14)
    assert found.error > 5 * found.batches.std(axis=0).max() / 8
    assert bank.excess(case, found) <= 1.0


@pytest.mark.parametrize(("jump", "seen"), [(0.003, "the cost jumps"), (2.0, "in the pilot")])
def test_jump_that_nobody_declares_makes_the_reference_zeroth_order(jump, seen):
    found = bank.certified(ridge(bank.power(1), bank.step(0.5, jump), dim=3), 1 << 16)
    assert "zeroth_order" in found.method
    assert seen in found.note


def test_disagreement_of_the_check_is_acted_upon(monkeypatch):
    """First order wrong by 20% where neither a jump nor the pilot shows it."""
    monkeypatch.setattr(reference._Sampler, "_doubt_of_first_order", lambda self: "")
    case = ridge(bank.power(1), bank.power(2, 0.1))
    problem = Numpy().compile(case.program)
    plain = problem.grad
    monkeypatch.setattr(problem, "grad", lambda theta, w: 1.2 * plain(theta, w))
    found = certify(problem, Numpy.provides, 1 << 17, 0.005)
    assert "zeroth_order" in found.method
    assert "disagree" in found.note
    assert bank.excess(case, found) <= 1.0


def test_check_says_what_it_could_resolve():
    found = bank.certified(ridge(bank.power(1), bank.power(2, 0.1)), 1 << 16)
    assert abs(found_at(found, "check_z")) < 5
    # zeroth order of a quarter of the samples, without the linear part, resolves a gradient of size 2 to 0.3%
    assert 0.001 < found_at(found, "check_resolves") < 0.02
    assert found.note == ""


def test_closed_form_is_used_where_there_is_one():
    problem = Numpy().compile(compose(Heaviside()))
    assert certify(problem, Numpy.provides, SAMPLES, 0.005).method == "closed_form"
    assert certify(problem, Numpy.provides | {"physics"}, SAMPLES, 0.005).method != "closed_form"


# ------------------------------------------------------------------------------------------------ jumps on lines


def in_single(x):
    """A cost in single precision."""
    return (6.0 + np.sin(x[0].astype(np.float32))).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(
    ("cost", "jump"),
    [
        (lambda x: x[0] + 0.01 * (x[1] > 0.3), 0.01),
        (lambda x: np.sin(5 * x[0]) + np.abs(x[1]), 0.0),
        (lambda x: 1e6 * np.maximum(x[0] - 0.2, 0) ** 2, 0.0),
        (lambda x: 1e9 + np.sin(x[0]), 0.0),
        (lambda x: np.sqrt(np.abs(x[0])), 0.0),
        (lambda x: np.full(x.shape[1], np.nan), 0.0),
        (in_single, 0.0),
        (lambda x: in_single(x) + (x[0] > 0.3), 1.0),
        # six parts in 1e11 of a line: its last change is a sixteenth of the one before
        (lambda x: np.clip((x[0] - 0.37) / 1.2e-10, 0.0, 1.0), 0.0),
    ],
    ids=["jump", "kink", "stiff", "rounding", "root", "nan", "single", "jump in single", "steep ramp"],
)
def test_largest_jump(cost, jump):
    draw = np.random.default_rng(0)
    starts, ends = draw.standard_normal((2, 2, 8))
    starts[0], ends[0] = -1.0, 1.0
    assert largest_jump(cost, starts, ends).height == pytest.approx(jump, rel=1e-4)


# ----------------------------------------------------------------------------------------------- which method it takes


def test_jumps_that_no_list_holds_are_not_for_a_rule_in_the_plane():
    law = SimpleNamespace(continuous=False)
    listed = SimpleNamespace(contact=law, continuous=False, breakpoints=lambda: ((0.1,),))
    assert reference._unlisted_jumps(listed), "a contact law jumps elsewhere than the scene"
    assert not reference._unlisted_jumps(SimpleNamespace(contact=None, continuous=False, breakpoints=lambda: ((0.1,),)))
    plane = ridge(bank.power(1), bank.step(0.5, 1.0), dim=2, says=False)
    assert bank.certified(plane, SAMPLES).method.startswith("sampling")


@pytest.mark.parametrize(
    ("mean", "spread", "chosen", "error"),
    [
        (1.0, 0.0, "quadrature", 0.5),
        (1.0, 0.01, "sampling", 0.0),
        (1.3, 0.01, "sampling", 0.3),
        (1.0, 9.0, "quadrature", 0.5),
        (3.0, 0.01, "quadrature", 2.0),
    ],
    ids=["no spread", "less spread", "off, less spread", "more spread", "disagree"],
)
def test_samples_replace_a_coarse_rule_that_they_agree_with(monkeypatch, mean, spread, chosen, error):
    """Samples that leave less error do, never ones that all missed the event. A disagreement is the stated error."""
    batches = mean + spread * np.linspace(-1.0, 1.0, BATCHES)[:, None]
    monkeypatch.setattr(reference._Sampler, "reference", lambda _: reference.Reference(batches, "sampling[n=64]"))
    monkeypatch.setattr(reference, "integrate", lambda *_: Integral(np.array([1.0]), 0.5, 1, 1.0))
    found = bank.certified(ridge(bank.power(1), dim=1), SAMPLES)
    assert found.method.startswith(chosen)
    assert found.error == pytest.approx(error)
    assert ("disagree" in found.note) == (mean == 3.0)
