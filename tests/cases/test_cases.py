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
WRONG, RIGHT = 1, 0
CASES = [
    ("c02_so3_log:cost grad=torch", WRONG, "nan_gradient", "differences 0"),
    ("c02_so3_log:smooth grad=torch", RIGHT, "smooth", ""),
    ("c04_unconverged_implicit:cost grad=implicit", WRONG, "missing_term", ""),
    ("c04_unconverged_implicit:cost grad=implicit refined=converged", WRONG, "missing_term", ""),
    ("c11_quaternion:cost grad=unit", WRONG, "missing_term", "along theta itself"),
    ("c13_second_step_nan:cost grad=grad horizons=1,2,3", WRONG, "nan_gradient", "from step 2 on"),
    ("c15_buffer:cost grad=grad", RIGHT, "", ""),
    ("c15_buffer:cost grad=double", WRONG, "wrong_factor", ""),
    ("c15_buffer:work grad=work_grad", RIGHT, "", ""),
    # 4,096 pairs do not resolve grad J here: not shown, though it is biased
    ("c22_own_noise_jump:cost grad=pathwise noise=1", 3, "spread", ""),
    ("c22_own_noise_jump:many grad=pathwise noise=20 calls=40000", WRONG, "biased", ""),
    ("c23_batch_mixing:cost grad=grad sigma=0.01", RIGHT, "smooth", ""),
    ("c24_guarded_acos:cost grad=torch sigma=0.001", RIGHT, "", "warning"),
    ("m1_atol:cost grad=grad atol=1e-2", RIGHT, "", "small error, within the tolerance"),
    ("m1_atol:cost grad=grad", WRONG, "", ""),
    ("m1_atol:flat grad=residue sigma=0.3", WRONG, "staircase", ""),
]  # fmt: skip
"""Arguments of ``examine``, exit status, cause where it is known, and words of the report."""
SCENES = [
    ("table_edge", "jump"), ("far_stop", "missed_slope"), ("corner_catch", "jump"), ("inside_box", "nan_gradient"),
]  # fmt: skip


LONG = ("sigma", "noise", "torch", "jax", "refined")
"""Words of cases that take longer: with noise, with an import of a library, or with a second program."""


@pytest.mark.parametrize(
    ("words", "status", "cause", "said"),
    [pytest.param(*case, id=case[0], marks=[pytest.mark.slow] * any(w in case[0] for w in LONG)) for case in CASES],
)
def test_a_public_case_gets_its_verdict(words, status, cause, said):
    place, *settings = words.split()
    file, _, name = place.partition(":")
    calls = 12_000 if "sigma" in words or "noise" in words else 2_000
    report = run([f"{HERE / file}.py:{name}", f"calls={calls}", *settings, "--quiet"])
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
    assert main(["gradcheck", *words]) == 1, capsys.readouterr().out
    rows = pd.read_parquet(tmp_path / "gradcheck" / "rows.parquet")
    assert verdict in np.concatenate(rows["check_verdict"].to_numpy())


@pytest.mark.slow
def test_the_kit_refuses_a_plugin_with_a_fault():
    assert main(["check", "inside_box", PLUGINS]) == 1
