"""Common random numbers: what their key holds, what is kept when more are drawn, and that nobody can change them."""

from functools import cache

import numpy as np
import pytest

from bench.measure import noise
from bench.model import Design

KEY = {"seed": 3, "scene": "one", "repeats": 2, "samples": 5, "width": 3, "stream": "cells"}


@pytest.mark.parametrize("other", [{"seed": 4}, {"scene": "two"}, {"stream": "check"}])
def test_every_part_of_the_key_counts(other):
    assert not np.intersect1d(noise.draw(**KEY), noise.draw(**KEY | other)).size
    np.testing.assert_array_equal(noise.draw(**KEY), noise.draw(**KEY))


def test_repeats_differ_and_stay_when_there_are_more():
    drawn = noise.draw(**KEY)
    assert drawn.shape == (2, 5, 3)
    assert np.unique(drawn).size == drawn.size
    more = noise.draw(**KEY | {"repeats": 4, "samples": 9})
    np.testing.assert_array_equal(more[:2, :5], drawn)


def test_nobody_can_change_what_cells_share():
    with pytest.raises(ValueError, match="read-only"):
        noise.draw(**KEY)[0, 0, 0] = 1.0


def test_parts_end_with_the_last_sample(monkeypatch):
    monkeypatch.setattr(noise, "HELD", 6)
    parts = list(noise.parts(3, "one", 1, 5, 3, "cells"))
    assert [part.shape for part in parts] == [(3, 2), (3, 2), (3, 1)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), noise.draw(**KEY)[1].T)


DESIGNS = [
    Design(mirrored=True, width=2, held=1),
    Design("orthogonal", False, 2, 1, block=2),
    Design("orthogonal", True, 2, 1, block=2),
    Design("sobol", False, 2, 1, block=8),
    Design("sobol", True, 2, 1, block=4),
]
NAMES = [f"{design.draws}{', mirrored' * design.mirrored}" for design in DESIGNS]
REPEATS = 2000


@cache
def many(design):
    """Many estimates of 8 samples of a design."""
    return noise.draw(**KEY | {"repeats": REPEATS, "samples": 8}, design=design)


@pytest.mark.parametrize("design", DESIGNS, ids=NAMES)
def test_each_draw_of_a_design_is_standard_normal(design):
    drawn = many(design)
    for sample in range(8):
        moments = np.stack([drawn[:, sample] ** power for power in (1, 2, 3, 4)]).mean(axis=1)
        errors = np.sqrt(np.array([1.0, 2.0, 15.0, 96.0]) / REPEATS)[:, None]
        assert (np.abs(moments - np.array([0.0, 1.0, 0.0, 3.0])[:, None]) < 4.5 * errors).all()


@pytest.mark.parametrize("design", DESIGNS, ids=NAMES)
def test_units_are_independent_and_mirrored_draws_hold_the_own_noise(design):
    drawn = many(design)
    first, other = drawn[:, : design.unit], drawn[:, design.unit :]
    apart = np.einsum("ria,rjb->iajb", first, other) / REPEATS
    assert (np.abs(apart) < 5.0 / np.sqrt(REPEATS)).all()
    if design.mirrored:
        np.testing.assert_array_equal(drawn[:, 1::2, :2], -drawn[:, ::2, :2])
        np.testing.assert_array_equal(drawn[:, 1::2, 2:], drawn[:, ::2, 2:])


def test_kept_noise_has_a_bound_and_gives_what_is_drawn(monkeypatch):
    monkeypatch.setattr(noise, "_kept", kept := {})
    monkeypatch.setattr(noise, "KEPT", 2 * noise.draw(**KEY).size)
    for seed in (1, 2, 3, 1):
        given = KEY | {"seed": seed}
        np.testing.assert_array_equal(noise.shared(**given), noise.draw(**given))
        assert len(kept) <= 2


def test_mirrored_draws_are_the_first_half_of_the_independent_ones():
    half = noise.draw(**KEY | {"samples": 4})
    np.testing.assert_array_equal(noise.draw(**KEY | {"samples": 8}, design=Design(mirrored=True))[:, ::2], half)


def test_orthogonal_draws_are_orthogonal_and_have_the_lengths_of_the_independent_ones():
    plain = noise.draw(**KEY | {"samples": 6})
    drawn = noise.draw(**KEY | {"samples": 6}, design=Design("orthogonal", width=3, block=3))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=2), np.linalg.norm(plain, axis=2))
    np.testing.assert_allclose(drawn[:, ::3], plain[:, ::3])
    for block in (drawn[:, :3], drawn[:, 3:]):
        products = np.einsum("ria,rja->rij", block, block)
        np.testing.assert_allclose(products, products * np.eye(3), atol=1e-12)


def test_a_sobol_set_has_one_point_in_each_cell():
    from scipy.special import ndtr

    drawn = noise.draw(**KEY | {"samples": 16}, design=Design("sobol", width=3, block=16))
    cells = np.sort(np.floor(16 * ndtr(drawn)), axis=1)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(16.0)[None, :, None], cells.shape))


@pytest.mark.parametrize("design", DESIGNS, ids=NAMES)
@pytest.mark.parametrize("held", [6, 20, 50])
def test_parts_never_cut_a_unit(monkeypatch, design, held):
    monkeypatch.setattr(noise, "HELD", held)
    key = KEY | {"samples": 16}
    parts = list(noise.parts(3, "one", 1, 16, 3, "cells", design))
    assert all(part.shape[1] % design.unit == 0 for part in parts)
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), noise.draw(**key, design=design)[1].T)
