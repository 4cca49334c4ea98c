"""What makes two cells the same: parameters to their last bit, sources, settings; and what does not."""

import math
from dataclasses import replace

import pandas as pd
import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from helpers import TINY

from bench.cli import main
from bench.errors import UserError
from bench.experiment import config, grid
from bench.experiment.keys import fingerprint
from bench.report.views import arrange
from bench.run import plan, tasks
from bench.run.store import Store

PLAIN = ["scenes=[pushing]", "contacts=[penalty]", "backends=[numpy]", "estimators=[fobg,alpha_order]"]


def cells(*words):
    return grid.cells(config.load([*PLAIN, *words]))


def test_configurations_a_bit_apart_have_keys_of_their_own():
    stiffness = [1000.0, math.nextafter(1000.0, math.inf), math.nextafter(1000.0, 0.0)]
    sigma = [0.1, math.nextafter(0.1, 1)]
    found = cells("estimators=[fobg]", f"sweep.stiffness={stiffness}", f"sweep.sigma={sigma}", "sweep.seed=[0,1]")
    assert len({cell.key for cell in found}) == len(found) == 12


def test_two_parameters_of_a_plugin_with_the_same_value_are_two_cells():
    """A cell with a bias of .3 was taken for the one with a noise of .3, and never ran."""
    both = "sweep.union=[{planted.noise: [0.3]}, {planted.bias: [0.3]}]"
    assert len({cell.key for cell in cells("estimators=[planted]", both)}) == 2


def test_the_same_value_written_otherwise_is_the_same_cell():
    written = ["1", "1.0", "1e0", "10e-1"]
    assert len({cells(f"scene.pushing.mass={value}")[0].key for value in written}) == 1
    assert cells("sweep.stiffness=[1, 1.0]")[0].key == cells("sweep.stiffness=[1]")[0].key
    assert len(cells("sweep.stiffness=[1, 1.0]")) == 2


def test_texts_that_look_like_numbers_are_not_numbers(capsys):
    """A value that a parameter refuses is refused too when an equal one of another type was taken before."""
    words = ["plan", "scenes=[bounce_once]", "contacts=[impulse]", "backends=[numpy]"]
    assert main([*words, "contact.impulse.time_of_impact=true"]) == 0
    capsys.readouterr()
    assert main([*words, "sweep.time_of_impact=[1]"]) == 2
    assert "must be true or false" in capsys.readouterr().err
    assert main([*words, "sweep.time_of_impact=['true']"]) == 2


@pytest.mark.parametrize(
    "word",
    [
        "seed=1",
        "samples=255",
        "repeats=63",
        "reference.samples=8192",
        "reference.tolerance=0.01",
        "timing=false",
        "scene.pushing.mass=0.2",
        "backend.numpy.dtype=float32",
        "study=growth",
        "study=bias_variance[timed_calls=6]",
        "theta=[mass]",
        "theta0=[" + ",".join(["0.5"] * 30) + "]",
    ],
)
def test_what_decides_numbers_is_in_the_key(word):
    before = {cell.key for cell in cells()}
    assert before.isdisjoint(cell.key for cell in cells(word))


@pytest.mark.parametrize(
    "word",
    [
        "name=other",
        "results_dir=elsewhere",
        "workers=1",
        "timeout=1m",
        "memory=1g",
        "on_error=stop",
        "versions=rerun",
        "question=why",
    ],
)
def test_what_decides_none_is_not(word):
    assert [cell.key for cell in cells()] == [cell.key for cell in cells(word)]


def test_budget_of_references_is_no_part_of_studies_without_them():
    study = "study=gradient_check"
    assert [c.key for c in cells(study)] == [c.key for c in cells(study, "reference.samples=8192")]


def test_sign_of_zero_is_seen():
    plus, minus = (replace(cells()[0].contact, damping=zero) for zero in (0.0, -0.0))
    assert plus == minus
    assert fingerprint(plus) != fingerprint(minus)


def test_refused_cells_have_keys():
    words = ["scenes=[pushing]", "contacts=[complementarity]", "backends=[numpy]", "integrators=[event_driven]"]
    assert all(cell.key for cell in cells(*words))


# -------------------------------------------------------------------------------------------------- policies


@pytest.mark.slow
def test_other_versions_are_reported_and_rerun_when_asked(tmp_path, capsys, monkeypatch):
    words = [*TINY, f"results_dir={tmp_path}"]
    assert main(words) == 0
    capsys.readouterr()
    for module in (plan, tasks):
        monkeypatch.setattr(module, "versions", lambda backend: "numpy=9.9")
    assert main(["plan", *words]) == 0
    assert "2 stored, 0 to run" in capsys.readouterr().out
    assert main(words) == 0
    assert "2 stored rows were made with numpy=" in capsys.readouterr().err
    assert main([*words, "versions=ignore"]) == 0
    assert "were made with" not in capsys.readouterr().err
    assert main([*words, "versions=rerun"]) == 0
    assert set(Store(tmp_path / "tiny", COLUMNS).load()["versions"]) == {"numpy=9.9"}
    assert main(["plan", *words]) == 0
    assert "2 stored, 0 to run" in capsys.readouterr().out


def test_failed_rows_run_when_they_are_retried_and_unavailable_ones_once_they_can(tmp_path, capsys):
    words = [*TINY, "estimators=[fobg,inverse_variance]", "samples=1", f"results_dir={tmp_path}"]
    store = Store(tmp_path / "tiny", COLUMNS)

    def planned(*more):
        capsys.readouterr()
        assert main(["plan", *words, *more]) == 0
        return capsys.readouterr().out

    assert main(words) == 0
    rows = store.load()
    assert "at least 4 samples" in rows.query("status == 'unsupported'")["reason"].item()
    ok = rows.query("status == 'ok'").iloc[0].drop(COLUMNS.of_kind("list")).to_dict()
    store.append(ok | {"status": "error"})
    assert "2 stored, 0 to run" in planned()
    assert "1 stored, 1 to run" in planned("retry=[error]")
    store.append(ok | {"status": "unavailable"})
    assert "1 stored, 1 to run" in planned()


# ------------------------------------------------------------------------------------------ experiments that join


def folder_with(tmp_path, **files):
    (tmp_path / "experiment").mkdir()
    for name, lines in files.items():
        (tmp_path / "experiment" / f"{name}.yaml").write_text("# @package _global_\n" + "\n".join(lines) + "\n")
    return [tmp_path]


OWN = ["name: main", "scenes: [pushing]", "contacts: [penalty]", "backends: [numpy]", "estimators: [fobg]"]
OTHER = ["name: other", "scenes: [pushing, pendulum]", "contacts: [impulse]", "backends: [numpy]", "estimators: [fobg]"]


def test_cells_of_an_experiment_that_joins_have_their_own_contact_law_and_the_settings_of_the_command_line(tmp_path):
    folders = folder_with(tmp_path, main=[*OWN, "also: [other]"], other=[*OTHER, "also: [main]"])
    found = grid.cells(config.load(["experiment=main", "samples=8"], folders))
    assert [(cell.scene.name, cell.contact.name if cell.contact else "") for cell in found] == [
        ("pushing", "penalty"),
        ("pushing", "impulse"),
        ("pendulum", ""),
    ]
    assert {cell.samples for cell in found} == {8}
    alone = grid.cells(config.load(["experiment=other", "samples=8", "also=[]"], folders))
    assert [cell.key for cell in found[1:]] == [cell.key for cell in alone]


def test_an_axis_of_an_experiment_that_joins_is_an_axis_of_the_report(tmp_path):
    parts = {
        "main": [*OWN, "also: [other]", "sweep: {sigma: [0.1]}"],
        "other": [*OTHER, "sweep: {damping: [0.1, 0.2]}"],
    }
    experiment = config.load(["experiment=main"], folder_with(tmp_path, **parts))
    rows = pd.DataFrame([tasks.blank_row(experiment, cell) for cell in grid.cells(experiment)])
    assert {"sigma", "damping"} <= {axis.column for axis in arrange(experiment, rows).axes}


def test_an_experiment_of_another_study_cannot_join(tmp_path):
    folders = folder_with(tmp_path, main=[*OWN, "also: [other]"], other=[*OTHER, "study: optimise"])
    with pytest.raises(UserError, match="also: other has another study"):
        config.load(["experiment=main"], folders)
