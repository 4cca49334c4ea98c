"""Each fault planted in a stored log is recognised and named with its number, and a healthy log has none."""

import numpy as np
import pytest
from bench.plugins.studies.train.verdicts import RULES, judge

from bench.model.trainer import LOGGED

N = 100
RNG = np.random.default_rng(0)
HEALTHY = {
    **{f"log_{name}": [] for name in LOGGED},
    "log_update": np.arange(1, N + 1),
    "log_loss": 10.0 - 0.05 * np.arange(N) + 0.1 * RNG.standard_normal(N),
    "log_reward": -10.0 + 0.05 * np.arange(N) + 0.1 * RNG.standard_normal(N),
    "log_gradient_norm": 1.0 + 0.2 * RNG.random(N),
    "log_parameter_largest": 1.0 + 0.01 * np.arange(N),
    "log_deviation": np.full(N, 0.3),
    "log_penetration": np.zeros(N),
    "curve_update": np.array([0.0, 25.0, 50.0, 75.0, 100.0]),
    "curve_return": np.array([-100.0, -80.0, -60.0, -50.0, -45.0]),
    "cosine": [0.8, 0.7, 0.75],
    "slope_errors": [1e-7, 2e-4, np.nan],
    "gradient_zero": np.nan,
}


def verdicts(**planted):
    run = {**HEALTHY, **planted}
    returns = np.asarray(run["curve_return"], dtype=float)
    return judge({**run, "curve_return_low": returns - 2.0, "curve_return_high": returns + 2.0})


def entries(name, where, value):
    column = np.array(HEALTHY[name])
    column[where] = value
    return {name: column}


def gradient(where, factor):
    """The healthy norms, some of them with a factor."""
    return entries("log_gradient_norm", where, factor * HEALTHY["log_gradient_norm"][where])


SETTLED = {"curve_return": [-100.0, -60.0, -61.0, -59.0, -60.0]}
DEEPER = np.linspace(1e-3, 4e-3, N) + 1e-5 * RNG.standard_normal(N)
PLANTED = {
    "a NaN": (entries("log_gradient_norm", slice(12, None), np.nan), "not_finite", 13),
    "zeros": (gradient(slice(None), 0.0), "zero", 1),
    "zeros from an update on": (gradient(slice(70, None), 0.0), "zero", 71),
    "nine of ten updates are zero, and each entry has the largest of ten": ({"gradient_zero": 0.9}, "zero", None),
    "a peak": (gradient(slice(42, 43), 5e3), "explodes", 43),
    "a peak in the first ten updates": (gradient(slice(4, 5), 1e4), "explodes", 5),
    "a jump in the first ten updates": (gradient(slice(5, None), 1e4), "grows", 6),
    "a jump": (gradient(slice(30, None), 1e4), "grows", 31),
    "growth of 12% an update": ({"log_gradient_norm": 1.12 ** np.arange(N)}, "grows", 42),
    "a gradient that vanishes": (gradient(slice(40, None), 1e-4) | SETTLED, "vanishes", 40),
    "an array with a wrong gradient": ({"slope_errors": [1e-7, np.nan, 9.0]}, "differences", None),
    "opposed gradients": ({"cosine": [-0.5, -0.4, -0.45]}, "opposed", None),
    "ascent": ({"curve_return": [-100.0, -120, -140, -150, -170]}, "falls", 0),
    "a collapse at the end": ({"curve_return": [-100.0, -80.0, -60.0, -50.0, -90.0]}, "falls", 75),
    "a soft contact": ({"log_penetration": DEEPER}, "soft_contact", None),
    "parameters that grow 90 times": (entries("log_parameter_largest", slice(60, None), 90.0), "parameters", 61),
    "a small deviation": (entries("log_deviation", slice(80, None), 1e-5), "deviation", 81),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_is_the_only_one_named(name):
    planted, code, update = PLANTED[name]
    (found,) = verdicts(**planted)
    assert found["code"] == code
    assert update in (None, found.get("update"))


def test_every_fault_is_planted():
    assert {code for _, code, _ in PLANTED.values()} == set(RULES)


HARMLESS = {
    "nothing": {},
    "a trainer that logs its reward only": {f"log_{name}": np.nan for name in LOGGED if name != "reward"},
    "a peak that clipping absorbs": gradient(slice(42, 43), 50.0),
    "a small gradient while the return rises": gradient(slice(40, None), 1e-4),
    "a gradient that vanishes for a while": gradient(slice(20, 80), 1e-4) | SETTLED,
    "deeper contacts at the same reward": {"log_penetration": DEEPER, "log_reward": -10.0 + RNG.standard_normal(N)},
    "a return that worsens within its interval": {"curve_return": [-100.0, -98, -97, -96, -99]},
    "a return that loses a part of its rise": {"curve_return": [-100.0, -80, -60, -50, -60]},
    "two comparisons of gradients": {"cosine": [-0.5, -0.4]},
    "a search without differences": {"slope_errors": np.nan, "cosine": []},
    "slopes that are not known": {"slope_errors": [np.nan] * 3},
}


@pytest.mark.parametrize("name", HARMLESS)
def test_a_healthy_log_shows_no_fault(name):
    assert verdicts(**HARMLESS[name]) == []
