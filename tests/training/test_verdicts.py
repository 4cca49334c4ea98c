"""Each fault planted in a log is recognised, named with its numbers, and a healthy log has none."""

import numpy as np
import pytest

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


def fault(found, code):
    """The only fault found, which has a code."""
    assert [one["code"] for one in found] == [code]
    return found[0]


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
    one = fault(found, "explodes")
    assert (one["update"], one["contact"]) == (43, 41)
    assert 400 < one["factor"] < 500


def test_a_gradient_that_explodes_without_contact_names_none():
    found = verdicts(gradient_norm=with_value("gradient_norm", [30, 60, 61], 1e4))
    one = fault(found, "explodes")
    assert "contact" not in one
    assert (one["update"], one["peaks"]) == (31, 3)


def test_a_contact_long_before_the_explosion_is_not_named():
    found = verdicts(
        gradient_norm=with_value("gradient_norm", 80, 1e4), contacts=with_value("contacts", slice(10, None), 1.0)
    )
    one = fault(found, "explodes")
    assert one["update"] == 81
    assert "contact" not in one


def test_a_gradient_that_returns_to_its_usual_size_does_not_explode():
    assert fault(verdicts(gradient_norm=with_value("gradient_norm", slice(5, 40), 1e-4)), "returns")["update"] == 41


def test_a_gradient_that_explodes_and_stays_large():
    norm = HEALTHY["gradient_norm"] * np.where(np.arange(N) < 30, 1.0, 1e4)
    one = fault(verdicts(gradient_norm=norm, contacts=with_value("contacts", slice(29, None), 1.0)), "explodes")
    assert (one["update"], one["contact"]) == (31, 30)
    assert one["lasting"] == pytest.approx(1e4, rel=0.05)


def test_a_gradient_that_grows_step_by_step():
    """By 12% an update: 25 updates before, where the median lies, it was 17 times smaller, so that no update jumps.

    The medians of the first and last 10 updates are 90 updates apart: 1.12^90 = 2.7e4.
    """
    one = fault(verdicts(gradient_norm=1.12 ** np.arange(N)), "grows")
    assert one["factor"] == pytest.approx(2.7e4, rel=0.02)
    assert one["update"] == 47


RISING_NO_MORE = [*RETURNS[:2], [-60, -62, -58], [-61, -63, -59], [-60, -62, -58]]


def test_a_gradient_that_vanishes_while_the_return_rises_no_more():
    vanishing = HEALTHY["gradient_norm"] * np.where(np.arange(N) < 40, 1.0, 1e-4)
    one = fault(verdicts(gradient_norm=vanishing, returns=RISING_NO_MORE[:1] + [RISING_NO_MORE[2]] * 4), "vanishes")
    assert one["update"] == 41
    assert one["factor"] == pytest.approx(9900, rel=0.01)


def test_a_gradient_that_becomes_small_while_the_return_rises_is_no_fault():
    assert verdicts(gradient_norm=HEALTHY["gradient_norm"] * np.where(np.arange(N) < 40, 1.0, 1e-4)) == []


def test_a_gradient_that_vanishes_and_returns_is_named_by_its_return_only():
    """Also where it was small for most of the run: what counts is its size before."""
    found = verdicts(gradient_norm=with_value("gradient_norm", slice(20, 80), 1e-4), returns=RISING_NO_MORE)
    assert fault(found, "returns")["update"] == 81


def test_a_gradient_of_all_zeros():
    one = fault(verdicts(gradient_norm=np.zeros(N)), "zero")
    assert (one["update"], one["zero"], one["updates"]) == (1, 100, 100)


def test_a_gradient_that_becomes_zero():
    found = verdicts(gradient_norm=with_value("gradient_norm", slice(70, None), 0.0))
    one = fault(found, "zero")
    assert (one["update"], one["zero"], one["updates"]) == (71, 30, 100)


def test_a_nan_names_its_update_and_quantity():
    found = verdicts(gradient_norm=with_value("gradient_norm", slice(12, None), np.nan))
    assert found == [{"code": "not_finite", "update": 13, "quantity": "gradient norm"}]


def test_a_return_that_rises_while_penetration_doubles():
    depth = np.linspace(1e-3, 4e-3, N) + 1e-5 * RNG.standard_normal(N)
    found = verdicts(penetration=depth, contacts=np.full(N, 1.0))
    assert fault(found, "soft_contact")["factor"] == pytest.approx(3.4, abs=0.05)


def test_a_penetration_that_doubles_while_the_reward_stays_is_not_that_fault():
    assert verdicts(penetration=np.linspace(1e-3, 4e-3, N), reward=-10.0 + RNG.standard_normal(N)) == []


def test_a_loss_that_falls_while_the_return_worsens():
    worse = np.array(RETURNS)
    worse[-1] = [-90, -92, -88]
    worse[1] = [-40, -42, -38]
    one = fault(verdicts(returns=worse), "worse")
    assert (one["update"], one["best"], one["last"]) == (25, -40.0, -90.0)
    assert one["loss_after"] < one["loss_before"]


def test_a_return_that_worsens_within_its_interval_is_open():
    last = np.array(RETURNS)
    last[-1] = [-51, -56, -46]
    assert verdicts(returns=last) == []


def test_parameters_that_leave_their_scale():
    found = verdicts(parameter_largest=with_value("parameter_largest", slice(60, None), 300.0))
    assert fault(found, "parameters")["value"] == 300.0


def test_a_deviation_that_collapses():
    one = fault(verdicts(deviation=with_value("deviation", slice(60, None), 1e-5)), "deviation")
    assert (one["update"], one["value"]) == (61, 1e-5)


def test_a_gradient_that_differences_contradict():
    assert verdicts(probe={"difference_error": 0.5}) == [{"code": "differences", "error": 0.5}]


def test_a_first_order_gradient_that_points_away():
    opposed = np.array([[10.0, -0.5, -0.6], [50.0, -0.4, -0.6], [90.0, -0.45, -0.6]])
    assert fault(verdicts(cosines=opposed), "opposed")["cosine"] == pytest.approx(-0.45)


def test_two_comparisons_give_no_verdict():
    opposed = np.array([[10.0, -0.5, -0.6], [50.0, -0.4, -0.6]])
    assert verdicts(cosines=opposed) == []


def test_windows_that_are_always_cut():
    assert fault(verdicts(cut=np.ones(N)), "cut")["share"] == 1.0
