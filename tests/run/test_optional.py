"""What is optional can be removed: core, JAX, NumPy, the main sweep and gradcheck run without every other folder."""

import shutil
import subprocess
import sys

import pytest
from trees import ROOT

FOLDERS = ["fused", "trainers", "policies", "claims", "engines"]
STUDIES = [
    path.stem
    for path in (ROOT / "plugins" / "studies").iterdir()
    if path.stem not in ("__init__", "__pycache__", "bias_variance", "gradient_check")
]
SCRIPT = """
from bench.cli import main
small = ["workers=0", "formats=[]", "results_dir=results"]
scene = ["scenes=[quadratic]", "samples=4", "repeats=2", "reference.samples=256", "timing=false"]
assert main(["name=main", *scene, "backends=[jax,numpy]", "estimators=[fobg,reinforce]", *small]) == 0
assert main(["gradcheck", "quadratic", "backends=[jax,numpy]", *small]) == 0
import pandas as pd
rows = pd.read_parquet("results/main/rows.parquet")
assert len(rows) == 4 and (rows["status"] == "ok").all()
"""


@pytest.mark.slow
@pytest.mark.parametrize("without", [FOLDERS, [f"studies/{name}" for name in STUDIES]])
def test_main_sweep_and_gradcheck_need_no_optional_folder(tmp_path, without):
    for name in ("bench", "plugins", "conf"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in without:
        place = tmp_path / "plugins" / name
        shutil.rmtree(place) if place.is_dir() else place.with_suffix(".py").unlink()
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
