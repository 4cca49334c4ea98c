"""Each fault planted in a log is recognised, named with its numbers, and a healthy log has none."""

import numpy as np
import pytest

from bench.studies.train.findings import WORDS, describe
from bench.studies.train.verdicts import Log, judge

N = 100
RNG = np.random.default_rng(0)
HEALTHY = {
    "loss": 10.0 - 0.05 * np.arange(N) + 0.1 * RNG.standard_normal(N),
    "reward": -10.0 + 0.05 * np.arange(N) + 0.1 * RNG.standard_normal(N),
    "gradient_norm": 1.0 + 0.2 * RNG.random(N),
    "parameter_largest": 1.0 + 0.01 * np.arange(N),
    "deviation": np.full(N, 0.3),
    "contacts": np.zeros(N),
    "penetration": np.zeros(N),
    "cut": np.full(N, 0.1),
}
EVALUATED = np.array([0.0, 25.0, 50.0, 75.0, 100.0])
RETURNS = np.array([[-100.0, -102, -98], [-80, -82, -78], [-60, -62, -58], [-50, -52, -48], [-45, -47, -43]])
COSINES = np.array([[10.0, 0.8, 0.9], [50.0, 0.7, 0.9], [90.0, 0.75, 0.9]])


def verdicts(returns=RETURNS, cosines=COSINES, probe=None, **planted):
    columns = {**HEALTHY, **planted}
    log = Log([{name: column[i] for name, column in columns.items()} for i in range(N)])
    return judge(log, EVALUATED, np.asarray(returns), cosines, probe or {"difference_error": 1e-4})


def words(found):
    assert len(found) == 1, found
    return describe(found[0])


def with_value(name, where, value):
    column = np.array(HEALTHY[name])
    column[where] = value
    return column


def test_a_healthy_log_shows_no_fault():
    assert verdicts() == []


def test_a_gradient_that_explodes_after_the_contact_starts():
    found = verdicts(
        gradient_norm=with_value("gradient_norm", 42, 500.0), contacts=with_value("contacts", slice(40, None), 0.5)
    )
    assert words(found).startswith("the gradient explodes 2 updates after the contact starts (update 43), to 4")


def test_a_gradient_that_explodes_without_contact_names_none():
    found = verdicts(gradient_norm=with_value("gradient_norm", [30, 60, 61], 1e4))
    assert "contact" not in words(found)
    assert words(found).startswith("the gradient explodes at update 31, to ")
    assert words(found).endswith("and 2 more times")


def test_a_contact_long_before_the_explosion_is_not_named():
    found = verdicts(
        gradient_norm=with_value("gradient_norm", 80, 1e4), contacts=with_value("contacts", slice(10, None), 1.0)
    )
    assert words(found).startswith("the gradient explodes at update 81")


def test_a_gradient_that_returns_to_its_usual_size_does_not_explode():
    text = words(verdicts(gradient_norm=with_value("gradient_norm", slice(5, 40), 1e-4)))
    assert text.startswith("the gradient nearly vanishes before update 41 and then grows 1")
    assert text.endswith("to its usual size")


def test_a_gradient_that_explodes_and_stays_large():
    norm = HEALTHY["gradient_norm"] * np.where(np.arange(N) < 30, 1.0, 1e4)
    text = words(verdicts(gradient_norm=norm, contacts=with_value("contacts", slice(29, None), 1.0)))
    assert text.startswith("the gradient explodes 1 update after the contact starts (update 31), to ")
    assert text.endswith("times its median before, and stays at about 1.0e4 times")


def test_a_gradient_that_grows_step_by_step():
    """By 12% an update: 25 updates before, where the median lies, it was 17 times smaller, so that no update jumps.

    The medians of the first and last 10 updates are 90 updates apart: 1.12^90 = 2.7e4.
    """
    text = words(verdicts(gradient_norm=1.12 ** np.arange(N)))
    assert text.startswith("the gradient grows step by step, 2.7e4 times in all")
    assert text.endswith("above 100 times its first size from update 47 on")


RISING_NO_MORE = [*RETURNS[:2], [-60, -62, -58], [-61, -63, -59], [-60, -62, -58]]


def test_a_gradient_that_vanishes_while_the_return_rises_no_more():
    vanishing = HEALTHY["gradient_norm"] * np.where(np.arange(N) < 40, 1.0, 1e-4)
    text = words(verdicts(gradient_norm=vanishing, returns=RISING_NO_MORE[:1] + [RISING_NO_MORE[2]] * 4))
    assert text.startswith("the gradient nearly vanishes from update 41 on, 9900 times below its size before")
    assert text.endswith("converged or is stuck")


def test_a_gradient_that_becomes_small_while_the_return_rises_is_no_fault():
    assert verdicts(gradient_norm=HEALTHY["gradient_norm"] * np.where(np.arange(N) < 40, 1.0, 1e-4)) == []


def test_a_gradient_that_vanishes_and_returns_is_named_by_its_return_only():
    """Also where it was small for most of the run: what counts is its size before."""
    text = words(verdicts(gradient_norm=with_value("gradient_norm", slice(20, 80), 1e-4), returns=RISING_NO_MORE))
    assert text.startswith("the gradient nearly vanishes before update 81")


def test_a_gradient_of_all_zeros():
    assert words(verdicts(gradient_norm=np.zeros(N))) == "the gradient is exactly zero in all 100 updates"


def test_a_gradient_that_becomes_zero():
    found = verdicts(gradient_norm=with_value("gradient_norm", slice(70, None), 0.0))
    assert words(found) == "the gradient is exactly zero from update 71 on, in 30 of 100 updates"


def test_a_nan_names_its_update_and_quantity():
    found = verdicts(gradient_norm=with_value("gradient_norm", slice(12, None), np.nan))
    assert words(found) == "NaN at update 13: the gradient norm is not finite"


def test_a_return_that_rises_while_penetration_doubles():
    depth = np.linspace(1e-3, 4e-3, N) + 1e-5 * RNG.standard_normal(N)
    found = verdicts(penetration=depth, contacts=np.full(N, 1.0))
    assert "penetration grows 3.4 times" in words(found)
    assert words(found).endswith("the policy uses the soft contact")


def test_a_penetration_that_doubles_while_the_reward_stays_is_not_that_fault():
    assert verdicts(penetration=np.linspace(1e-3, 4e-3, N), reward=-10.0 + RNG.standard_normal(N)) == []


def test_a_loss_that_falls_while_the_return_worsens():
    worse = np.array(RETURNS)
    worse[-1] = [-90, -92, -88]
    worse[1] = [-40, -42, -38]
    text = words(verdicts(returns=worse))
    assert text.startswith("the loss falls (")
    assert text.endswith("while the return worsens from -40.0 at update 25 to -90.0")


def test_a_return_that_worsens_within_its_interval_is_open():
    last = np.array(RETURNS)
    last[-1] = [-51, -56, -46]
    assert verdicts(returns=last) == []


def test_parameters_that_leave_their_scale():
    assert "parameters are unphysical: the largest is 300" in words(
        verdicts(parameter_largest=with_value("parameter_largest", slice(60, None), 300.0))
    )


def test_a_deviation_that_collapses():
    assert words(verdicts(deviation=with_value("deviation", slice(60, None), 1e-5))).startswith(
        "the actions' deviation is unphysical: 1.0e-5 at update 61"
    )


def test_a_gradient_that_differences_contradict():
    assert (
        "open: central differences at the steps tried do not agree with the gradient (relative error of at least 0.50)"
        in words(verdicts(probe={"difference_error": 0.5}))
    )


def test_a_first_order_gradient_that_points_away():
    opposed = np.array([[10.0, -0.5, -0.6], [50.0, -0.4, -0.6], [90.0, -0.45, -0.6]])
    assert "points away from the zeroth-order one: cosine -0.45" in words(verdicts(cosines=opposed))


def test_two_comparisons_give_no_verdict():
    opposed = np.array([[10.0, -0.5, -0.6], [50.0, -0.4, -0.6]])
    assert verdicts(cosines=opposed) == []


def test_windows_that_are_always_cut():
    assert words(verdicts(cut=np.ones(N))).startswith("the gradient is cut in 100% of windows")


@pytest.mark.parametrize("code", WORDS)
def test_every_code_has_words_without_a_full_stop_or_semicolon(code):
    numbers = {"update": 3, "quantity": "loss", "zero": 10, "updates": 20, "factor": 4.0, "peaks": 2, "error": 0.5,
               "cosine": -0.5, "low": -0.6, "high": -0.4, "best": 1.0, "last": 0.0, "loss_before": 2.0, "loss_after": 1.0,
               "before": 0.1, "after": 0.4, "reward_before": 0.0, "reward_after": 1.0, "first": 1.0, "value": 200.0,
               "share": 0.95, "lasting": 500.0}  # fmt: skip
    text = describe({"code": code, **numbers})
    assert text
    assert ";" not in text
    assert not text.endswith(".")
