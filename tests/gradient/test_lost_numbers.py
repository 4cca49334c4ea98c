"""What noise reaches is checked too: gradients and costs that are not numbers, wherever they lie."""

import numpy as np
import pytest

from bench import load
from bench.cli import main
from bench.measure.jumps import sampled_gradients
from bench.model import compose, registry

GUARDED = """
import math
theta = [0.0]
def cost(x): return 0.001 * x[0]
def gradient(x): return [0.001 if x[0] > -0.67 else math.nan]
"""
"""A branch that is discarded in the value only, 2.2 standard deviations from theta."""
LOG = "import numpy as np\ntheta = [0.0]\ndef cost(x): return np.log(x[0] + 0.6)\n"


def words(tmp_path, text):
    (tmp_path / "mysim.py").write_text(text)
    grad = "gradient" if "gradient" in text else "''"
    return [
        f"scene.callable.grad={grad}",
        f"scene.callable.cost={tmp_path}/mysim.py:cost",
        "scene.callable.sigma=0.3",
        "backends=[callable]",
        "workers=0",
        f"results_dir={tmp_path}",
        "formats=[]",
    ]


@pytest.mark.parametrize(("text", "verdict"), [(GUARDED, "nan_gradient"), (LOG, "nonfinite")])
def test_numbers_lost_under_noise_are_no_right_gradient(tmp_path, text, verdict, capsys):
    assert main(["gradcheck", "callable", *words(tmp_path, text)]) == 1
    assert f"{verdict} (noise" in capsys.readouterr().out
    (row,) = load(tmp_path / "gradcheck").to_dict("records")
    found = dict(zip(row["point"], row["check_verdict"], strict=True))
    assert found == {"start": "smooth", "noise": verdict}
    assert "under noise are not numbers" in row["reason"]


def test_share_and_nearest_sample_of_lost_gradients():
    scene = registry.make("scenes", "quadratic", {"sigma": 1.0})
    problem = registry.make("backends", "numpy", {}).compile(compose(scene, None, None))
    right = problem._grad
    problem._grad = lambda theta, w: np.where(w[0] > 1.0, np.nan, right(theta, w))
    gradients, costs, spread = sampled_gradients(problem, problem.program.theta0, 0, 128)
    assert gradients.share == pytest.approx(0.159, abs=4 * 0.016)  # 1 - Phi(1), and its standard error
    assert gradients.w[0] > 1.0
    assert costs.share == 0.0
    assert spread == np.inf


@pytest.mark.parametrize("samples", [1, 10_000])
def test_trusted_is_a_column_and_the_last_line(tmp_path, samples, capsys):
    words = ["scene.quadratic.sigma=1", f"samples={samples}", "backends=[numpy]", "workers=0", "formats=[]"]
    assert main(["gradcheck", "quadratic", *words, f"results_dir={tmp_path}"]) == 0
    (row,) = load(tmp_path / "gradcheck").to_dict("records")
    answer = "yes" if row["spread"] < 0.5 else "no"
    assert row["trusted"] == answer == ("no" if samples == 1 else "yes")
    assert f"trusted: 1 {answer}" in capsys.readouterr().out
