"""Averages over an axis, and quantities of single samples, on problems with a closed form."""

import numpy as np
import pytest
from helpers import loaded

from bench import run
from bench.errors import UserError
from bench.report.averages import averages

WORDS = (
    "scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg,reinforce]", "timing=false", "workers=0", "repeats=8",
    "samples=4000", "average=[theta0]",
)  # fmt: skip


@pytest.fixture(scope="module")
def stepped(tmp_path_factory):
    """First and zeroth order on a unit step at three thetas, and the experiment."""
    folder = tmp_path_factory.mktemp("averages")
    words = [*WORDS, "name=step", "sweep.theta0=[-0.1,0,0.1]", "sweep.sigma=[0.1,0.2]", f"results_dir={folder}"]
    return loaded(*words)[0], run(words), folder / "step"


def test_single_samples_of_a_step_are_zero_where_theory_says(stepped):
    _, rows, _ = stepped
    table = rows.set_index(["estimator", "sigma", "theta0"]).sort_index()
    # differences of the cost see the jump in the few samples that lie within 1e-6 of it
    assert (table.loc["fobg", "sample_zeros"] > 0.999).all()
    # the zeroth-order term is 0 where the sample lies on theta's side of the jump: Phi(|theta| / sigma)
    for (sigma, theta), share in ((0.1, 0.1), 0.841345), ((0.2, 0.0), 0.5):
        row = table.loc[("reinforce", sigma, theta)]
        error = np.sqrt(share * (1 - share) / 32000)
        assert row["sample_zeros"] == pytest.approx(share, abs=4 * error)
        assert row["sample_low"] == 0.0
        assert 0 < row["sample_high"] < 4 / sigma


def test_averages_are_those_of_the_rows(stepped):
    experiment, rows, folder = stepped
    table = averages(experiment, rows)
    assert set(table["sigma"]) == {0.1, 0.2}
    part = rows[(rows["estimator"] == "fobg") & (rows["sigma"] == 0.1)]
    line = table[(table["estimator"] == "fobg") & (table["sigma"] == 0.1)].set_index("quantity").loc["rmse"]
    assert line["points"] == 3
    assert line["mean"] == pytest.approx(part["rmse"].mean())
    assert line["rms"] == pytest.approx(np.sqrt((part["rmse"] ** 2).mean()))
    assert (line["least"], line["largest"]) == (part["rmse"].min(), part["rmse"].max())
    signed = table[(table["estimator"] == "fobg") & (table["sigma"] == 0.1)].set_index("quantity").loc["signed error"]
    slopes = np.exp(-0.5 * np.array([1.0, 0.0, 1.0])) / (np.sqrt(2 * np.pi) * 0.1)
    means = np.concatenate(part["mean_estimate"].to_list())
    assert signed["mean"] == pytest.approx(abs(means.mean() - slopes.mean()), rel=1e-5)
    assert {"averages.md", "averages.csv"} <= {path.name for path in folder.iterdir()}


def test_signed_errors_of_opposite_sign_cancel(stepped):
    experiment, rows, _ = stepped
    part = rows[(rows["estimator"] == "fobg") & (rows["sigma"] == 0.1)].head(2)
    part = part.assign(
        mean_estimate=[np.array([1.0]), np.array([-1.0])], reference_gradient=[np.array([0.0]), np.array([0.0])]
    )
    line = averages(experiment, part).set_index("quantity").loc["signed error"]
    assert (line["mean"], line["rms"]) == (0.0, 1.0)


def test_an_axis_that_is_not_swept_is_refused():
    with pytest.raises(UserError, match=r"did you mean 'theta0'"):
        loaded(*WORDS[:-1], "average=[theta]", "sweep.theta0=[0]")
    with pytest.raises(UserError, match="nothing is swept"):
        loaded(*WORDS)


@pytest.mark.slow
def test_an_average_over_starts_is_the_mean_error_that_a_claim_takes(tmp_path):
    """C14 at five starts: a sweep with ``average``, and the claim's own gradients."""
    from bench.claims.published.soft_wall import _mean_error

    starts = [0.5, 0.504, 0.508, 0.512, 0.516]
    words = [
        "name=wall", "scenes=[wall_penalty_1d[dt=0.02,horizon=100]]", "contacts=[penalty]", "backends=[numpy]",
        "estimators=[fobg]", "samples=8", "repeats=4", "timing=false", "workers=0", "reference.samples=256",
        f"sweep.start={starts}".replace(" ", ""), "average=[start]", f"results_dir={tmp_path}",
    ]  # fmt: skip
    rows = run(words)
    line = averages(loaded(*words)[0], rows).set_index("quantity").loc["model_error"]
    # 1e-5: the claim has the exact slope with six digits
    assert line["mean"] == pytest.approx(_mean_error(0.02, (np.array(starts) - 0.02) / 1.48), abs=1e-5)
