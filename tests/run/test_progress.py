"""The line of progress keeps bar, counts and time at 80 columns, and a run says what it is busy with."""

import io
from types import SimpleNamespace

import pytest
from rich.cells import cell_len
from rich.console import Console

from bench.cli import main
from bench.experiment import config
from bench.run import launchers, progress
from bench.run.execute import execute

PUSHING = [
    "scenes=[pushing]",
    "scene.pushing.horizon=2",
    "backends=[numpy]",
    "estimators=[reinforce]",
    "samples=8",
    "repeats=4",
    "workers=0",
    "timing=false",
    "reference.samples=256",
    "reference.tolerance=9",
]
LONG = "pushing, penalty[stiffness=1e4], jax, alpha_order[delta=0.95,gamma=4,sharing=shared]"


def planned(n_stored, n_due, n_refused=0):
    one = SimpleNamespace
    return (
        [one(stored=True, runs=False)] * n_stored
        + [one(stored=False, runs=True)] * n_due
        + [one(stored=False, runs=False)] * n_refused
    )


@pytest.mark.parametrize("width", [40, 80, 200])
def test_the_bar_of_a_terminal_is_one_line_of_its_width(width):
    console = Console(file=io.StringIO(), width=width, force_terminal=True)
    bars = progress.bars_on(console)
    bar = progress.Progress("stiffness_sweep", planned(12, 600), bars)
    bar.working(LONG + "\x1b[31m")
    bar.finished({"status": "timeout"})
    (line,) = console.render_lines(bars.get_renderable(), pad=False)
    text = "".join(segment.text for segment in line)
    assert "13/612, 1 timeout" in text
    assert ("shared" in text) == (width == 200)
    assert "\x1b" not in text
    assert cell_len(text.rstrip()) <= width


def lines_of(name, cells):
    return progress.Progress(name, cells, progress.bars_on(Console(file=io.StringIO()), disable=True), lines=True)


def test_refused_and_stored_cells_are_counted_as_done(capsys):
    counted = lines_of("mine", planned(5, 20, n_refused=50))
    for status in ["unsupported"] * 50 + ["ok"] * 9 + ["error"]:
        counted.finished({"status": status})
    assert counted._counts() == "65/75, 1 error"
    task = counted._bars.tasks[0]
    assert (task.completed, task.total) == (10, 20), "refused cells make the rest look quick"
    assert capsys.readouterr().err == "mine: 5 of 75 cells are stored\n"


def test_a_run_says_after_5_s_which_reference_it_computes(monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    lines = lines_of("mine", planned(0, 12))
    for clock[0] in (101.0, 104.9, 105.1, 106.0, 115.0, 115.2):
        lines.working("reference of callable callable (2 of 12 references done)")
    said = capsys.readouterr().err.splitlines()
    assert said == ["mine: 0/12 cells; now reference of callable callable (2 of 12 references done)"] * 2


def test_references_are_counted_while_they_are_computed(tmp_path, monkeypatch):
    lines = []
    monkeypatch.setattr(launchers, "BATCH_S", -1.0)  # otherwise answers of quick tasks come together
    monkeypatch.setattr(progress.Progress, "working", lambda self, text: lines.append(text))
    execute(config.load([*PUSHING, "sweep.sigma=[0.1,0.2]", f"results_dir={tmp_path}"]), quiet=True)
    counted = [line for line in lines if line.startswith("reference of pushing")]
    assert counted[0].endswith("(0 of 2 references done)")
    assert any(line.endswith("(1 of 2 references done)") for line in counted)
    assert not any("references done" in line for line in lines if not line.startswith("reference"))


def test_a_plan_counts_references_until_they_are_stored(tmp_path, capsys):
    words = [*PUSHING, f"results_dir={tmp_path}"]
    assert main(["plan", *words]) == 0
    assert (
        "references to compute: 1, each of at most 256 samples and 16,384 points of quadrature"
        in capsys.readouterr().out
    )
    execute(config.load(words))
    assert main(["plan", *words, "samples=9"]) == 0
    assert "references" not in capsys.readouterr().out.replace("without new references", "")
