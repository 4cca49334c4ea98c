"""Fits of parameters: what a record tells in closed form, the Cramer-Rao bound, coverage, basins and time steps."""

import math
import re

import numpy as np
import pandas as pd
import pytest
import wrong_models
from bench.plugins.studies.identify import adequacy
from bench.plugins.studies.identify import views as shown
from bench.plugins.studies.identify.fitting import information
from bench.plugins.studies.identify.information import Information, product
from bench.plugins.studies.identify.missing import missing_terms
from bench.plugins.studies.identify.model import model_of
from bench.plugins.studies.identify.record import evaluate
from helpers import loaded, stored, unmeasured
from scipy.integrate import solve_ivp

import bench
from bench.errors import Unsupported
from bench.experiment import config

SPRING = ("scenes=[mass_spring_damper]", "integrators=[rk4]")
FORCED = ("scenes=[mass_spring_damper[force=0.5]]", "integrators=[rk4]")
STEPPED = 1e-4
"""Relative error of rk4 at 0.05 s against the closed form of the motion, in what is compared here."""


GIVEN = ("study=identify", "backends=[numpy]", "optimizers=[gauss_newton]", "samples=1")


def cell_of(*words):
    _, (cell,) = loaded(*GIVEN, *words)
    return cell


def known(*words):
    """The information of a record with noise .01."""
    model = model_of(cell_of(*words))
    return information(model, model.values, 0.01)


def row_of(*words):
    cell = cell_of(*words)
    return cell.study.measure(cell, None)


def displacement(k, c, t):
    """x(t) of a unit mass released from rest at 1."""
    a = c / 2
    w = np.sqrt(k - a * a)
    return np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t))


@pytest.mark.parametrize(
    ("words", "labels"),
    [
        (SPRING, ["stiffness/mass", "damping/mass"]),
        (FORCED, ["mass", "stiffness", "damping"]),
        ((*FORCED, "theta=[mass,stiffness,damping,force]"), ["stiffness/mass", "damping/mass", "force/mass"]),
    ],
)
def test_a_known_force_lifts_the_gauge_and_an_unknown_gain_brings_it_back(words, labels):
    found = known(*words)
    assert found.labels == labels
    if words == SPRING:
        assert found.bound == pytest.approx([0.00261307 / 4, 0.00128568 / 0.4], rel=STEPPED)


def test_words_of_products():
    names = ("a", "b", "c")
    assert product(names, np.array([1.0, -0.5, 0.0])) == "a/b^(1/2)"
    square = Information(names, np.array([[2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))  # a^2 b and c
    assert square.labels == ["a^2*b", "c"]
    assert Information(names, np.zeros((2, 3))).labels == []
    assert Information(names, np.diag([1.0, 1.0, 0.0])[:2]).labels == ["a", "b"]  # c moves nothing


@pytest.mark.slow
def test_a_row_in_all_ways():
    row = row_of("scenes=[mass_spring_damper[horizon=80]]", "integrators=[rk4]", "repeats=12")
    assert row["shooting"] == ["single", "multiple", "windows"]
    assert row["hidden"] == [0, 0, 0]
    assert min(row["converged"]) == 1.0
    assert row["error"][0] == pytest.approx(row["error"][1], rel=0.05)  # windows that meet are one rollout
    assert row["error"][0] < row["error"][2]  # windows on their own know less
    assert all(low <= 0.95 <= high for low, high in zip(row["coverage_low"], row["coverage_high"], strict=True))
    assert row["step_shift_bound"] < shown.MAX_STEP_SHIFT


def test_model_of_a_coarse_step_says_so():
    row = row_of("study=identify[refine=16]", "scenes=[sliding_block]", "repeats=16")
    assert row["step_shift_bound"] > shown.MAX_STEP_SHIFT
    assert row["coverage_high"][0] < 0.95


def refused(*words):
    cell = cell_of(*words)
    return cell.study.refusal(cell)


def test_refusals(tmp_path):
    assert "names no unknowns: name parameters of it, theta=[..]" in refused("scenes=[pendulum]")
    assert "is a plain function" in refused("scenes=[quadratic]")
    assert "samples, and fits are compared" in refused("scenes=[sliding_block]", "optimizers=[cem]")
    assert refused("scenes=[pendulum]", "theta=[mass]") is None
    with pytest.raises(
        bench.UserError, match=r"unknown parameter in theta of scene pendulum: 'mas'; did you mean 'mass'"
    ):
        refused("scenes=[pendulum]", "theta=[mas]")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "own.csv: No columns to parse"),
        (
            "1.0\n0.9\n",
            r"has 2 lines up to step 2, scene mass_spring_damper is measured 200 times, up to step 200: set horizon",
        ),
        ("x\n1.0\nnan\n0.8\n", r"line 3 \(nan\): not finite numbers"),
        ("1,0\n0,9\n", r"has 2 columns, .* is measured in 1 positions: name them, .*; numbers need decimal points"),
        ("1.0\n" * 200, "c0 is constant"),
        ("1.0\n0.9,0.8\n", "Expected 1 fields in line 2, saw 2"),
        ("t,x\n0.05,1\n0.1,2\n0.1,3\n", r"line 4 \(0.1, 3\): its time is not later than that before"),
        ("t,x\n0.05,1\n0.12,2\n", r"line 3 .*: its time is not a multiple of dt=0.05; interpolate=true resamples"),
        ("time,x\n0,1\n0.05,0.9\n", "has a column of times: write time=time"),
        ("s,x\n0.05,1\n0.1,2\n", r"'t': name 't' is not defined \(numbers, operations and abs, .* s, .*, x\)"),
    ],
)
def test_unusable_records_are_refused_in_a_line(tmp_path, text, message):
    path = tmp_path / "own.csv"
    path.write_text(text)
    time = ",time=t" if "x\n0.05" in text else ""
    reason = refused("scenes=[mass_spring_damper]", f"study=identify[record={path}{time}]")
    assert re.search(message, reason)
    assert reason.count("\n") == 0


def test_a_table_with_times_may_lack_lines_and_its_noise_is_estimated(tmp_path):
    """Laplace noise of .02 that is not stated, a line per step with the start, every seventh one missing."""
    t = 0.05 * np.arange(201)
    x = displacement(4.4, 0.5, t) + 0.02 / math.sqrt(2) * np.random.default_rng(1).laplace(size=201)
    table = pd.DataFrame({"t": t, "other": 1.0 + t, "x": x})
    table[np.arange(201) % 7 != 3].to_csv(tmp_path / "own.csv", index=False)
    row = row_of(*SPRING, f"study=identify[record={tmp_path / 'own.csv'},time=t,measured={{q0: x}}]")
    assert row["explained"] == 1.0
    assert row["noise_size"] == pytest.approx(0.02, rel=0.2)  # three standard errors of Laplace noise
    assert row["interval_noise"] == "own size"
    low, high = np.array(row["estimate_low"][:2]), np.array(row["estimate_high"][:2])
    assert ((low < [4.4, 0.5]) & (high > [4.4, 0.5])).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x.__class__", "'x.__class__': x.__class__ is not arithmetic"),
        ("x+hysteresis. __globals__. get(pd. name). read_pickle(x)", "is not arithmetic"),
        ("open('a')", "is not arithmetic"),
        ("@os", "invalid syntax"),
        ("abs", "name 'abs' is not defined"),
        ("x*mm", "name 'mm' is not defined"),
        ("x*", "'x\\*': invalid syntax"),
        ("9**9**9**9", "result out of range"),
        ("[x for x in (1,)]", "is not arithmetic"),
        ("x if x else 1", "is not arithmetic"),
        ("(" * 500 + "x" + ")" * 500, "nested"),
        ("-" * 3000 + "x", "recursion|nested|stack|parser"),
    ],
)
def test_expressions_are_arithmetic_only(text, message):
    assert evaluate("-x**2 / 4 + sin(pi/2)", {"x": np.array([2.0])}).tolist() == [0.0]
    with pytest.raises(bench.UserError, match=message):
        evaluate(text, {"x": 1.0})


def pendulum(tmp_path, friction=0.0, times=None, drag=0.2, angle=1.0):
    """A pendulum of .5 m with q'' = -2 g sin q - drag q' - friction sign q', in degrees, by an independent integrator."""
    times = 0.02 * np.arange(301) if times is None else times
    motion = solve_ivp(
        lambda t, x: [x[1], -9.81 / 0.5 * math.sin(x[0]) - drag * x[1] - friction * math.tanh(1e3 * x[1])],
        (0.0, times[-1]),
        [angle, 0.0],
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
        max_step=0.005,
    )
    noise = np.random.default_rng(4).standard_normal((2, len(times)))
    angle_, rate = np.degrees(motion.y + [[0.003], [0.03]] * noise)
    table = pd.DataFrame({"ms": 1000 * times, "angle_deg": angle_, "rate": rate, "torque": 0.0, "heat": 20 + noise[0]})
    table.to_csv(tmp_path / "pendulum.csv", index=False)
    return f"record={tmp_path / 'pendulum.csv'},time=ms/1000,measured={{q0: angle_deg*pi/180}}"


SWING = ("scenes=[pendulum[torque=0,horizon=300]]", "integrators=[rk4]", "theta=[damping,gravity]")


def test_irregular_times_are_resampled_and_starts_and_zeros_are_fitted(tmp_path):
    """The damping starts at 0 and the pendulum at an unknown angle; drag .2 is a damping of .05."""
    times = np.cumsum(np.random.default_rng(5).uniform(0.01, 0.03, 300))
    study = pendulum(tmp_path, times=np.append(0.0, times), angle=0.3)
    assert "not a multiple of dt=0.02; interpolate=true resamples" in refused(f"study=identify[{study}]", *SWING)
    row = row_of(f"study=identify[{study},interpolate=true]", *SWING[:2], "theta=[damping,gravity,start.q0]")
    assert row["parameter"] == ["damping", "gravity", "start.q0"]
    assert row["unit"][2] == ""
    # to 1%, since interpolation over .02 s flattens the swing
    assert row["estimate"] == pytest.approx([0.05, 9.81, 0.3], rel=0.01)
    assert row["start"][0] == 0.0
    assert row["estimate_low"][0] == pytest.approx(2 * row["estimate"][0] - row["estimate_high"][0])


def test_missing_terms_are_the_derivatives_of_the_record_by_them():
    model = wrong_models.PAIRS["pendulum"]
    theta = model.values
    found = missing_terms(model, theta, 1.0, {"wear": "v*q**2"})
    clean = wrong_models.pushed(model, "q", 0.0)
    for name, term in (("drag v|v|", "v*abs(v)"), ("spring q^3", "q**3"), ("wear", "v*q**2")):
        effect, expected = found[f"{name} of q0"], clean - wrong_models.pushed(model, term, 1e-4)
        scale = effect @ expected / (effect @ effect)
        # second order in the step, along the motion
        assert np.linalg.norm(expected - scale * effect) < 2e-3 * np.linalg.norm(expected)
    driven = model_of(cell_of("scenes=[cartpole]", "integrators=[rk4]", "theta=[pole_mass]"))
    names = set(missing_terms(driven, driven.values, 1.0))
    assert {"lag of u0", "dead zone of u0", "coupling with q1 of q0", "hysteresis of q1", "delay of sensor q0"} < names


def test_as_many_measurements_as_unknowns_need_a_stated_noise(tmp_path):
    (tmp_path / "two.csv").write_text("0.99\n0.97\n")
    short = ("scenes=[mass_spring_damper[horizon=2]]", "integrators=[rk4]", "theta=[stiffness,damping]")
    with pytest.raises(Unsupported, match="2 measurements for 2 unknowns: state the noise"):
        row_of(*short, f"study=identify[record={tmp_path / 'two.csv'}]")
    row = row_of(*short, f"study=identify[record={tmp_path / 'two.csv'},measurement=0.01]")
    assert math.isnan(row["explained"])  # too few to test


def table_of(*words):
    """The table of estimates by parameter, and that of biases that go unnoticed."""
    experiment, rows = unmeasured(*GIVEN, *words, **{name: [value] for name, value in row_of(*words).items()})
    views = experiment.study.views(experiment, rows)
    return views.tables[0].frame.set_index("parameter"), views.tables[1]


def test_estimates_come_first_and_only_what_is_identifiable_has_one(tmp_path):
    t = 0.05 * np.arange(1, 201)
    noise = 0.01 * np.random.default_rng(2).standard_normal(200)
    np.savetxt(tmp_path / "own.csv", displacement(4.4, 0.5, t) + noise)
    estimates, unnoticed = table_of(*SPRING, f"study=identify[record={tmp_path / 'own.csv'}]")
    assert list(estimates.index) == ["stiffness/mass", "damping/mass", "mass", "stiffness", "damping"]
    assert estimates["unit"].tolist() == ["(N/m)/kg", "(N s/m)/kg", "kg", "N/m", "N s/m"]
    assert estimates["identifiable"].tolist() == ["yes", "yes", "product", "product", "product"]
    assert estimates["estimate"].isna().tolist() == [False] * 2 + [True] * 3
    assert estimates.loc["damping/mass", "estimate_low"] < 0.5 < estimates.loc["damping/mass", "estimate_high"]
    assert estimates["start"].tolist() == pytest.approx([4.0, 0.4, 1.2, 4.8, 0.48])
    assert estimates["doubt"].tolist() == [""] * 5
    # dry friction can hide behind the damping
    terms = unnoticed.frame[unnoticed.frame["biased"] == "damping/mass"].set_index("term")
    assert terms.loc["dry friction of q0", "errors"] > 1.0
    assert estimates.loc["damping/mass", "bias"] >= terms["unnoticed"].max()


def test_a_parameter_that_moves_nothing_has_no_interval():
    words = ("theta=[stiffness,damping,hold]", "scene.mass_spring_damper.hold=1", "repeats=2")
    estimates, _ = table_of(*SPRING, *words)
    assert estimates.loc["hold", "identifiable"] == "no"
    assert estimates.loc["hold", ["estimate", "estimate_low", "estimate_high"]].isna().all()
    assert estimates.loc["stiffness", "identifiable"] == "yes"


def test_fits_take_gauss_newton_unless_another_optimizer_is_named():
    """A record of one's own, fitted by the default of other studies, ended elsewhere and the model was blamed."""
    for words, chosen in (
        (["study=identify"], "gauss_newton"),
        (["study=identify", "optimizers=[adam]"], "adam"),
        (["study=optimise"], "adam"),
    ):
        assert [str(choice) for choice in config.load([*words, *SPRING]).choices["optimizer"]] == [chosen]


# ------------------------------------------------------------------------------------- models that do not explain


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("noise normal", 0.0, 0.13),
        ("4 se: q**2", 0.95, 1.0),
        pytest.param("offset 0.5 sigma", 0.95, 1.0, marks=pytest.mark.slow),
        pytest.param("noise AR 0.9", 0.95, 1.0, marks=pytest.mark.slow),
        pytest.param("drift 0.5 sigma", 0.8, 1.0, marks=pytest.mark.slow),
    ],
)
def test_wrong_models_are_noticed_and_the_right_one_is_not_blamed(name, least, most):
    clean, noise = next((record, noise) for label, record, noise in wrong_models.cases("spring") if label == name)
    noticed, inside, printed, _ = wrong_models.run("spring", clean, noise, 24)
    assert least <= noticed <= most
    if "AR" in name:
        assert inside < 0.6 < 0.8 < printed


def without(line, data):
    """The residuals of data that a line is fitted to."""
    return data - line @ np.linalg.lstsq(line, data, rcond=None)[0]


def test_one_outlier_is_noticed():
    line = np.linspace(-1.0, 1.0, 200)[:, None]
    residual = without(line, np.random.default_rng(0).standard_normal(200))
    assert adequacy.judge(residual, line, 1, {}).is_explained
    residual[100] = 6.0
    verdict = adequacy.judge(residual, line, 1, {})
    assert not verdict.is_explained
    assert "largest residual" in verdict.contradictions


def judged(noise, records=40):
    """The share of records of 150 measurements and a line that are explained."""
    rng, line = np.random.default_rng(0), np.linspace(-1.0, 1.0, 150)[:, None]
    residuals = without(line, noise(rng, (150, records)))
    verdicts = [adequacy.judge(residuals[:, i], line, 1, {}, i) for i in range(records)]
    return np.mean([one.is_explained for one in verdicts])


@pytest.mark.parametrize(
    "name", ["Laplace", *(pytest.param(n, marks=pytest.mark.slow) for n in ("normal", "t5", "skewed"))]
)
def test_right_models_are_explained_whatever_the_noise_looks_like(name):
    # 5% by design for normal noise; the tails of 150 numbers are known roughly only
    assert judged(wrong_models.NOISES[name]) >= 0.8


@pytest.mark.parametrize(("rho", "least"), [(0.0, 0.9), (0.5, 0.85), (0.9, 0.8)])
def test_printed_intervals_follow_a_test_of_correlation(rho, least):
    line = np.cos(np.linspace(0.0, 20.0, 300))[:, None]
    inside, kinds = 0, []
    for seed in range(100):
        residual = wrong_models.autoregressive(np.random.default_rng(seed), (300, 1), rho)
        estimate = np.linalg.lstsq(line, residual, rcond=None)[0]
        variance, kind, quantile = adequacy.variances((residual - line @ estimate)[:, 0], line, 1)
        inside += abs(estimate[0, 0]) <= quantile * math.sqrt(variance[0])
        kinds.append(kind)
    assert inside / 100 >= least
    assert (kinds.count("correlated") <= 12) if rho == 0.0 else set(kinds) == {"correlated"}


@pytest.mark.slow
def test_a_missing_term_of_the_stated_reach_is_noticed_at_the_stated_power():
    line, rng = np.linspace(-1.0, 1.0, 150)[:, None], np.random.default_rng(5)
    term = {"cubic": line[:, 0] ** 3}
    noise = rng.standard_normal((150, 40))
    first = adequacy.judge(without(line, noise[:, 0]), line, 1, term)
    data = without(line, noise + first.reach["cubic"] * term["cubic"][:, None])
    noticed = np.mean([not adequacy.judge(data[:, i], line, 1, term, i).is_explained for i in range(40)])
    assert noticed >= adequacy.POWER - 0.1  # three standard errors


# ---------------------------------------------------------------------------------------------------- what is shown


def planted(**columns):
    """The verdict on 64 fits, some columns replaced."""
    good = {"converged": 1.0, "converged_low": 0.94, "converged_high": 1.0, "error": 1.0, "coverage_high": 0.98}
    lines = pd.DataFrame([good | columns])
    low, high = shown.error_interval(lines["error"], 64.0 * lines["converged"])
    return shown.verdicts(lines.assign(error_low=low, error_high=high))[0]


def test_verdicts_need_their_intervals():
    assert planted() == "precise"
    # below the stated level, but not by the whole interval
    assert planted(coverage_high=0.951) == "precise"
    assert planted(converged=0.85, converged_low=0.7, converged_high=0.93) == "open"
    assert planted(converged=0.7, converged_low=0.6, converged_high=0.8) == "unconverged"
    assert planted(error=math.nan, coverage_high=math.nan) == "open"
    assert planted(error=3.0, coverage_high=0.4) == "narrow"


def test_interval_of_the_error_covers():
    rng = np.random.default_rng(0)
    errors = pd.Series(np.sqrt(np.mean(rng.standard_normal((4000, 20)) ** 2, axis=1)))
    low, high = shown.error_interval(errors, pd.Series(np.full(4000, 20.0)))
    # 4,000 draws of a share of 0.95: three standard errors
    assert np.mean((low <= 1.0) & (high >= 1.0)) == pytest.approx(0.95, abs=0.0104)


def test_own_measurements_have_no_coverage_to_show():
    """With a record of one's own the truth is unknown: neither error nor coverage is drawn, and no fit counts as lost."""
    given, rows = stored("identify")
    drawn = given.study.views(given, rows).charts[0].frame
    first = drawn[drawn["series"] == drawn["series"].iloc[0]]  # a cross beside a coverage would look like a good one
    assert drawn["failed"].sum() == (first["converged"] == 0).sum() > 0
    gone = {
        name: [[math.nan] * len(v) for v in rows[name]]
        for name in ("error", "coverage", "coverage_low", "coverage_high")
    }
    views = given.study.views(given, rows.assign(**gone))
    assert "precise" not in set(views.tables[3].frame["verdict"])
    assert not views.charts
