"""Public bug reports about gradients, each with the right verdict: through the commands that users type."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.cli import main
from bench.errors import UserError
from bench.examine.command import run

HERE = Path(__file__).parent
PLUGINS = f"plugins={HERE / 'plugins_bugs'}"
WRONG, RIGHT, OPEN = 1, 0, 3
CASES = [
    ("c02_so3_log:cost grad=torch", WRONG, "nan_gradient", "differences 0"),
    ("c02_so3_log:smooth grad=torch", RIGHT, "smooth", ""),
    ("c04_unconverged_implicit:cost grad=implicit", WRONG, "missing_term", ""),
    ("c04_unconverged_implicit:cost grad=implicit refined=converged", WRONG, "missing_term", ""),
    ("c11_quaternion:cost grad=unit", WRONG, "missing_term", "along theta itself"),
    ("c13_second_step_nan:cost grad=grad horizons=1,2,3", WRONG, "nan_gradient", "NaN"),
    ("c15_buffer:cost grad=grad", RIGHT, "", ""),
    ("c15_buffer:cost grad=double", WRONG, "wrong_factor", ""),
    ("c15_buffer:work grad=work_grad", RIGHT, "", ""),
    ("c22_own_noise_jump:cost grad=pathwise noise=1", WRONG, "biased", ""),
    ("c22_own_noise_jump:many grad=pathwise noise=20 calls=40000", WRONG, "biased", ""),
    ("c23_batch_mixing:cost grad=grad sigma=0.01", RIGHT, "smooth", ""),
    ("c24_guarded_acos:cost grad=torch sigma=0.001", RIGHT, "", "warning"),
    ("m1_atol:cost grad=grad atol=1e-2", RIGHT, "", "small error, within the tolerance"),
    ("m1_atol:cost grad=grad", WRONG, "", ""),
    ("m1_atol:flat grad=residue sigma=0.3", WRONG, "staircase", ""),
    ("c01_eigh_degenerate:cost grad=torch sigma=0.01", WRONG, "nan_gradient", ""),
    ("c03_event_time:cost grad=frozen", WRONG, "disconnected", ""),
    ("c03_event_time:cost grad=exact", RIGHT, "", ""),
    ("c03_event_time:counted grad=zero calls=12000", WRONG, "staircase", ""),
    ("c05_backward_cg:cost grad=cg", WRONG, "disconnected", ""),
    ("c05_backward_cg:cost grad=stopped", WRONG, "wrong_adjoint", ""),
    ("c05_backward_cg:cost grad=right", RIGHT, "", ""),
    ("c06_step_size:cost grad=damped", WRONG, "", "0.298"),
    ("c07_accumulate:cost grad=doubled horizons=1,2,5,10,20 calls=3000", WRONG, "", "after fewer or more steps"),
    ("c08_lp_layer:cost grad=layer sigma=0.05,0.2", WRONG, "staircase", ""),
    ("c10_checkpoint_rng:cost grad=torch", WRONG, "missing_term", ""),
    ("c10_checkpoint_rng:plain grad=torch", RIGHT, "", ""),
    ("c12_detached_pupil:cost grad=torch", WRONG, "missing_term", ""),
    ("c12_detached_pupil:attached grad=torch", RIGHT, "", ""),
    ("c14_five_percent:cost grad=adjoint", WRONG, "", "off by 32%"),
    ("c16_exploding:cost grad=jax sigma=0.003", OPEN, "spread", ""),
    ("c21_argmax:cost grad=last sigma=0.1", WRONG, "", ""),
    ("m3_refined:cost grad=five refined=refined", WRONG, "wrong_factor", ""),
    ("c25_scipy_adaptive:cost grad=gradient", WRONG, "missing_term", "theta[2]: program -4.71"),
    ("c25_scipy_adaptive:cost grad=gradient refined=fine", WRONG, "missing_term", "theta[2]: program -4.71"),
    ("c25_scipy_adaptive:cost grad=exact", OPEN, "coarse", "+-"),
    ("c25_scipy_adaptive:cost grad=exact refined=fine", RIGHT, "smooth_part", ""),
    ("c25_scipy_adaptive:cost grad=forgets refined=fine", WRONG, "missing_term", ""),
    ("c26_tail_jump:cost grad=gradient sigma=0.1", OPEN, "spread", "not shown"),
    ("c27_nan_far:cost grad=torch sigma=0.3 calls=8000", WRONG, "nan_gradient", "NOT usable"),
    ("c28_event_order:cost grad=gradient sigma=0.3 calls=4000", OPEN, "spread", "not shown"),
    ("c29_two_faults:cost grad=gradient", WRONG, "disconnected", "(theta[1]: program 0, differences 0.0400000"),
    ("c30_noisy_pathwise:cost grad=gradient noise=20 sigma=0.01 calls=3000", OPEN, "spread", "NaN"),
    ("c31_mixed_units:cost grad=gradient sigma=x:0.01,k:1e4 calls=6000", WRONG, "disconnected", "a bias of 100%"),
    ("c32_interp_ceil:cost grad=jax sigma=0.01", WRONG, "disconnected", "differences 0.250000"),
    ("c32_interp_ceil:fixed grad=jax", RIGHT, "", ""),
    ("c33_bernoulli_score:cost grad=score noise=1 calls=150000", RIGHT, "estimator", "its mean is off by 0 to"),
    ("c33_bernoulli_score:cost grad=score noise=1 sigma=0.5 calls=150000", RIGHT, "estimator", ""),
    ("c33_bernoulli_score:cost grad=broken noise=1", WRONG, "biased", "its mean is off by"),
    ("c33_bernoulli_score:cost grad=pathwise noise=1", WRONG, "biased", "bias"),
    ("c34_perturbed_scale:cost grad=right noise=1", RIGHT, "estimator", ""),
    ("c34_perturbed_scale:cost grad=scaled noise=1", WRONG, "biased", "off by 90%"),
    ("c34_perturbed_scale:cost grad=pathwise noise=1", RIGHT, "smooth", ""),
    ("c35_clipped_action_score:cost grad=unclipped noise=1 calls=60000", RIGHT, "estimator", ""),
    ("c35_clipped_action_score:cost grad=clipped noise=1", WRONG, "biased", ""),
    ("c35_clipped_action_score:cost grad=pathwise noise=1", OPEN, "spread", ""),
    ("c36_permuted:cost grad=rolled", WRONG, "wrong_adjoint", "in another order"),
    ("c36_permuted:cost grad=right", RIGHT, "", ""),
    ("c37_log_parameter:cost grad=logged", WRONG, "wrong_adjoint", "by their logarithms"),
    ("c37_log_parameter:cost grad=degrees", WRONG, "wrong_factor", "57.296"),
    ("c37_log_parameter:cost grad=right", RIGHT, "", ""),
    ("c38_absolute_step:cost grad=scipy_like", WRONG, "wrong_adjoint", "a difference of the cost at a step of 1e-04"),
    ("c38_absolute_step:cost grad=right", RIGHT, "", ""),
    ("c39_bf16_matmul:cost grad=low horizons=1,5,15,30,60 calls=4000", WRONG, "wrong_adjoint", "a short float"),
    ("c39_bf16_matmul:cost grad=double horizons=1,5,15,30,60 calls=4000", RIGHT, "", ""),
    (
        "c40_backsolve:cost grad=backsolve horizons=1,3,10,20,60 calls=4000",
        WRONG,
        "continuous_adjoint",
        "after 60 steps",
    ),
    ("c40_backsolve:cost grad=exact horizons=1,3,10,20,60 calls=4000", RIGHT, "", ""),
]
"""Arguments of ``examine``, exit status, cause where it is known, and words of the report."""
SCENES = [
    ("table_edge", "jump"),
    ("far_stop", "missed_slope"),
    ("corner_catch", "jump"),
    ("inside_box", "nan_gradient"),
]


LONG = ("sigma", "noise", "torch", "jax", "refined", "horizons", "c05", "c06", "c25")
"""Words of cases that take longer: with noise, with an import of a library, or with a second program."""


@pytest.mark.parametrize(
    ("words", "status", "cause", "said"),
    [pytest.param(*case, id=case[0], marks=[pytest.mark.slow] * any(w in case[0] for w in LONG)) for case in CASES],
)
def test_a_public_case_gets_its_verdict(words, status, cause, said):
    place, *settings = words.split()
    file, _, name = place.partition(":")
    calls = 12_000 if "sigma" in words or "noise" in words else 2_000
    given = [] if "calls=" in words else [f"calls={calls}"]
    report = run([f"{HERE / file}.py:{name}", *given, *settings, "--quiet"])
    assert report.status == status, str(report)
    assert cause in ("", report.cause), str(report)
    assert said in str(report)


@pytest.mark.parametrize("words", ["cost grad=unsummed", "by_name theta=named grad=keyed"])
def test_a_gradient_of_another_shape_is_bad_input(words):
    name, *settings = words.split()
    with pytest.raises(UserError, match="gradient"):
        run([f"{HERE / 'c20_shape.py'}:{name}", *settings, "--quiet"])


@pytest.mark.parametrize(("scene", "verdict"), SCENES)
def test_gradcheck_refuses_what_sampled_gradients_miss(scene, verdict, tmp_path, capsys):
    words = [scene, "backends=[jax]", "workers=0", "sweep.horizon=[100]", PLUGINS, f"results_dir={tmp_path}", "--quiet"]
    words = words if scene == "table_edge" else [word for word in words if "horizon" not in word]
    status, said = main(["gradcheck", *words]), capsys.readouterr().out
    assert status == 1, said
    again = [line for line in said.splitlines() if "python -m bench gradcheck" in line]
    assert again
    assert all("plugins=" in line for line in again)
    rows = pd.read_parquet(tmp_path / "gradcheck" / "rows.parquet")
    assert verdict in np.concatenate(rows["check_verdict"].to_numpy())


@pytest.mark.slow
def test_the_kit_refuses_a_plugin_with_a_fault():
    assert main(["check", "inside_box", PLUGINS]) == 1
