"""Stored rows of the standard experiments come out again, by today's code."""

import json
from dataclasses import replace

import pandas as pd
import pytest
from golden_cells import is_installed, measure, moved_columns, name_of, parsed, session_of
from trees import ROOT

from bench.compare.sources import columns_of
from bench.engines.backend import EngineBackend
from bench.experiment import config
from bench.experiment.cell import Cell
from bench.experiment.experiment import Budget
from bench.host.parameters import build
from bench.model import Decision, registry

QUICK_S = 1.0
"""Rows whose cells took longer are left out, except the quickest one of an engine in another Python."""
FAST = {"quick"}
STORED = sorted(path.parent.name for path in ROOT.glob("results/standard/*/rows.parquet"))
CASES = [pytest.param(name, False, id=name, marks=[pytest.mark.slow] * (name not in FAST)) for name in STORED]
CASES += [pytest.param("engines", True, id="engines-mjx", marks=pytest.mark.full)]  # which compiles for a minute
ALLOWED = {"float64": 10.0, "float32": 1e6}
"""Tolerances of golden cells that stored rows may move by, since these are longer: 1e-7 as the double pendulum multiplies
rounding by 1e7; and 1% where the simulation has seven digits."""
COUNTED = {"rollouts", "gradients"}
"""Columns whose average includes calls that were timed."""
SEARCHED = {"start_cost", "optimum", "scene_class", "quality_rmse_rel", "quality_cosine", "quality_bias_share"}
"""The columns of a search that are compared: hundreds of iterations multiply rounding by more than any tolerance."""


def cell_of(row):
    """Return the cell of a stored row, from all its parameters."""
    given = json.loads(row["parameters"])
    study, theta, budget = given.pop("study"), given.pop("theta"), given.pop("reference")
    return Cell(
        {axis: part and registry.make(registry.kind_of(axis), part.pop("name"), part) for axis, part in given.items()},
        int(row["samples"]),
        int(row["repeats"]),
        int(row["seed"]),
        build(registry.usable("studies", study.pop("name")), study),
        Decision(**{n: v and tuple(v) for n, v in theta.items()}) if theta else Decision(),
        timing=False,
        budget=Budget(**budget) if budget else None,
    )


def sampled(rows):
    """Return a quick row, and one of each engine: golden cells have every plugin."""
    rows = rows[rows.status == "ok"]
    is_engine = rows.backend.map(
        lambda name: issubclass(registry.find("backends", name.partition("[")[0]).plugin, EngineBackend)
    ).astype(bool)
    quick = rows[(rows.wall_s < QUICK_S) & ~is_engine]
    engines = rows[is_engine].sort_values("wall_s").groupby("backend").head(1)
    return pd.concat([quick.head(1), engines])


@pytest.mark.parametrize(("name", "is_mjx"), CASES)
def test_stored_rows_come_out_again(name, is_mjx, tmp_path):
    registry.add_folder(ROOT / "examples/cost_of_error")
    rows = pd.read_parquet(ROOT / "results/standard" / name / "rows.parquet")
    rows = columns_of(rows["study"].iloc[0]).derive(rows)
    rows = sampled(rows[rows.backend.str.startswith("mjx") == is_mjx])
    pairs = [(cell_of(row), row) for _, row in rows.iterrows()]
    pairs = [(cell, row) for cell, row in pairs if is_installed(cell)]
    if not pairs:
        pytest.skip(f"no cell that can run here takes less than {QUICK_S} s")
    experiment = config.load([f"study={rows.study.iloc[0]}", "compile_cache=null"])
    session = session_of(replace(experiment, reference=pairs[0][0].budget or experiment.reference), tmp_path)
    moved = {}
    for cell, row in pairs:
        measured = measure(cell, session)
        compared = [
            column for column in measured if column in row and (row["study"] != "optimise" or column in SEARCHED)
        ]
        stored = {column: parsed(column, row[column]) for column in compared}
        allowed = ALLOWED[cell.backend.dtype]
        if columns := set(moved_columns(stored, {c: measured[c] for c in compared}, allowed)) - COUNTED:
            moved[name_of(cell)] = columns
    assert not moved
