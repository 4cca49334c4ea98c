"""How the noise of an estimate is drawn: what estimators refuse, what they equal, and what rows say of it."""

import numpy as np
import pytest

from bench import api
from bench.cli import main
from bench.errors import Unsupported
from bench.experiment.by_name import make
from bench.measure import noise

REFUSED = [
    ("randomized_smoothing[mirrored=true]", "pendulum", 128, "both ways already"),
    ("sphere_smoothing[mirrored=true]", "pendulum", 128, "both ways already"),
    ("quadratic_model[draws=sobol]", "pendulum", 128, "independent draws, without draws=sobol"),
    ("total_propagation[per=action,draws=sobol]", "pendulum", 128, "independent draws"),
    ("plain[mirrored=true]", "pendulum", 128, "no noise in J"),
    ("fobg[mirrored=true]", "pendulum", 99, "samples=99 is odd"),
    ("fobg[draws=sobol]", "pendulum", 100, "power of 2"),
    ("fobg[draws=sobol]", "linear[dimension=21202]", 128, "21,201 coordinates"),
    ("inverse_variance[mirrored=true]", "pendulum", 6, "4 independent units of mirrored=true"),
    ("inverse_variance[draws=sobol]", "pendulum", 96, "power of 2"),
    ("reinforce[draws=sobol]", "pendulum", 8, "no such units"),
    ("reinforce[draws=orthogonal]", "pendulum", 127, "no such units"),
    ("alpha_order[draws=sobol]", "pendulum", 4, "power of 2"),
    ("inverse_variance[draws=sobol,mirrored=true]", "pendulum", 128, None),
    ("optimal_baseline[draws=orthogonal]", "pendulum", 100, None),
    ("fobg[draws=orthogonal]", "pendulum", 97, None),
    ("reinforce[baseline=none,draws=sobol]", "pendulum", 2, None),
]
"""Estimator, scene, samples, and words of the reason; None where it is not refused."""


def problem_of(scene):
    return api.problem(scene, backend="numpy")


@pytest.mark.parametrize(("name", "scene", "samples", "words"), REFUSED, ids=lambda value: str(value)[:40])
def test_a_design_that_an_estimator_cannot_use_is_refused(name, scene, samples, words):
    estimator, program = make("estimators", name), problem_of(scene).program
    if words is None:
        assert estimator.design(program, samples).unit <= samples
        return
    with pytest.raises(Unsupported, match=words):
        estimator.design(program, samples)


@pytest.mark.parametrize(
    "name", ["randomized_smoothing[variant=forward]", "reinforce[baseline=center]", "reinforce[baseline=leave_one_out]"]
)
@pytest.mark.parametrize("scene", ["pendulum[horizon=10]", "coin_walk"])
def test_mirrored_draws_turn_zeroth_order_into_central_differences(name, scene):
    """At each pair's own noise of the scene, as in coin_walk."""
    problem = problem_of(scene)
    program = problem.program
    design = make("estimators", name.replace("]", ",mirrored=true]")).design(program, 16)
    drawn = noise.draw(0, "scene", 3, 16, program.n_noise, "cells", design)
    pairs = make("estimators", name.replace("]", ",mirrored=true]")).estimate(problem, program.theta0, drawn)
    central = make("estimators", "randomized_smoothing").estimate(problem, program.theta0, drawn[:, ::2])
    np.testing.assert_allclose(pairs, central, rtol=1e-9, atol=1e-12)


def test_hybrids_share_no_pair_between_their_halves():
    problem = problem_of("pendulum[horizon=3]")
    hybrid = make("estimators", "inverse_variance[mirrored=true]")
    drawn = noise.draw(0, "p", 1, 10, problem.program.n_noise, "cells", hybrid.design(problem.program, 10))
    weights = hybrid.estimate_with_diagnostics(problem, problem.program.theta0, drawn)[1]["weight"]
    first = np.stack([problem.grad(None, w) for w in drawn[0, :4]])
    zeroth = np.stack([problem.score(None, w) * (problem.value(None, w) - problem.value()) for w in drawn[0, 4:]])
    v1, v0 = (terms.reshape(-1, 2, problem.dim).mean(axis=1) for terms in (first, zeroth))
    v1, v0 = v1.var(axis=0, ddof=1) / 2, v0.var(axis=0, ddof=1) / 3
    np.testing.assert_allclose(weights[0], v0 / (v0 + v1), rtol=1e-6)


def test_a_design_is_a_setting_of_a_run_and_a_column_of_its_rows(tmp_path):
    rows = api.run(
        name="designs",
        scenes=["quadratic"],
        backends=["numpy"],
        estimators=["fobg", "randomized_smoothing"],
        samples=16,
        repeats=8,
        mirrored=True,
        sweep={"draws": ["iid", "sobol"]},
        results_dir=tmp_path,
        formats=[],
        workers=0,
    )
    good = rows[rows["status"] == "ok"]
    assert list(good["estimator"]) == ["fobg", "fobg"]
    assert list(good["draws"]) == ["iid", "sobol"]
    assert set(rows["mirrored"]) == {1.0}
    assert list(good["estimator_params"]) == ["mirrored=true", "draws=sobol,mirrored=true"]
    # samples that are drawn together have no variance of their own
    np.testing.assert_allclose(good["variance_per_sample"], 16 * good["variance"])
    assert rows.loc[rows["status"] != "ok", "reason"].str.contains("both ways already").all()


def test_only_a_design_other_than_the_default_counts_in_keys():
    from bench.experiment.keys import fingerprint

    plain = make("estimators", "fobg")
    assert fingerprint(make("estimators", "fobg[draws=iid,mirrored=false]")) == fingerprint(plain)
    assert (
        len({fingerprint(make("estimators", f"fobg[{given}]")) for given in ("", "mirrored=true", "draws=sobol")}) == 3
    )


def test_a_wrong_design_is_named(tmp_path, capsys):
    assert main(["name=x", "draws=sobl", "scenes=[quadratic]", f"results_dir={tmp_path}"]) == 2
    assert "did you mean 'sobol'" in capsys.readouterr().err
