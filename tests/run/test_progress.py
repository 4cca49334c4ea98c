"""The line of progress keeps bar, counts and time at 80 columns, and estimates no time before it can."""

import io
import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from bench.experiment import config
from bench.run import progress, runner
from bench.run.execute import execute
from bench.run.launchers import launcher
from bench.run.progress import progress_line, remaining_seconds
from bench.run.references import References

PUSHING = [
    "scenes=[pushing]", "scene.pushing.horizon=2", "backends=[numpy]", "estimators=[reinforce]", "samples=8", "repeats=4",
    "workers=0", "timing=false", "reference.samples=256", "reference.tolerance=9",
]  # fmt: skip
LONG = "pushing, penalty[stiffness=1e4], jax, alpha_order[delta=0.95,gamma=4,sharing=shared]"
FACTS = ["312/672, 3 timeout", "about 25 s left"]


def planned(n_stored, n_due, n_refused=0):
    one = SimpleNamespace
    return [one(stored=True, runs=False)] * n_stored + [one(stored=False, runs=True)] * n_due + [one(stored=False, runs=False)] * n_refused  # fmt: skip


@pytest.mark.parametrize("width", [79, 80, 100, 200])
def test_bar_counts_and_time_fit_80_columns(width):
    name, filled, empty, rest = progress_line(width, "stiffness_sweep_of_mine", 0.5, FACTS, LONG)
    assert cell_len(name) + filled + empty + cell_len(rest) <= width
    assert filled + empty >= 10
    assert filled == (filled + empty) // 2
    assert name.startswith("stiffness")
    assert all(fact in rest for fact in FACTS)
    assert ("jax" in rest) == (width == 200)


@pytest.mark.parametrize("width", range(1, 60))
def test_a_narrow_line_keeps_what_it_can(width):
    name, filled, empty, rest = progress_line(width, "名前" * 9, 2.0, FACTS, "名" * 50)
    assert cell_len(name) + filled + empty + cell_len(rest) <= width
    assert empty == 0
    assert FACTS[0] in rest or width < len(FACTS[0]) + 1


def test_the_bar_of_a_terminal_is_one_line_of_its_width():
    console = Console(file=io.StringIO(), width=80, force_terminal=True)
    bars = progress.bars_on(console)
    bar = progress.Bar("stiffness_sweep", planned(12, 600), bars)
    bar.working(LONG + "\x1b[31m")
    bar.finished(None, {"status": "timeout"})
    (line,) = console.render_lines(bars.get_renderable(), pad=False)
    text = "".join(segment.text for segment in line)
    assert "13/612, 1 timeout" in text
    assert "\x1b" not in text
    assert cell_len(text.rstrip()) <= 79


def after(durations, n_due, since=0.0):
    ends = np.cumsum(durations).tolist()
    return remaining_seconds(ends, n_due, ends[-1] + since)


def test_no_time_is_estimated_before_it_means_something():
    assert math.isnan(remaining_seconds([], 10, 0.0))
    assert math.isnan(after([1.0] * 5, 100)), "five cells are too few"
    assert math.isnan(after([0.1] * 20, 21)), "the first cells are cheap: two seconds say nothing"
    assert math.isnan(after([0.1] * 20 + [10.0], 31)), "then cells become expensive"
    assert math.isnan(after([1.0] * 10, 20, since=60.0)), "one cell takes much longer than the others"
    assert math.isnan(after([1.0] * 10, 10))


def test_a_steady_rate_gives_the_time():
    assert after([30.0] + [1.0] * 10, 21) == pytest.approx(10.0), "references and compilation are before the first"
    assert after([2.0] * 20, 100) == pytest.approx(160.0)
    slow = after([1.0] * 20 + [1.5] * 20, 80)
    assert 50.0 < slow <= 60.0


def test_refused_cells_take_no_time(monkeypatch):
    clock = iter(np.arange(0.0, 1000.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    counted = progress.Progress("mine", planned(5, 20, n_refused=50))
    for _ in range(50):
        counted.finished(None, {"status": "unsupported"})
    assert counted._remaining() == ""
    for _ in range(10):
        counted.finished(None, {"status": "ok"})
    assert counted._counts() == "65/75"
    assert counted._remaining() == "about 15 s left"


def test_a_run_says_after_5_s_which_reference_it_computes(monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    lines = progress.Lines("mine", planned(0, 12))
    for clock[0] in (101.0, 104.9, 105.1, 106.0, 115.0, 115.2):
        lines.working("reference of callable callable (2 of 12 references done)")
    said = capsys.readouterr().err.splitlines()
    assert said == ["mine: 0/12 cells; now reference of callable callable (2 of 12 references done)"] * 2


def test_a_run_in_this_process_says_which_reference_it_is_busy_with(tmp_path, monkeypatch, capsys):
    said = threading.Event()
    compute, show = References._compute, progress.Lines.show

    def busy(self, cell):
        assert said.wait(60), "nothing is said while a reference is computed"
        return compute(self, cell)

    def counted(self):
        show(self)
        if threading.current_thread() is not threading.main_thread():
            said.set()

    monkeypatch.setattr(References, "_compute", busy)
    monkeypatch.setattr(progress.Lines, "show", counted)
    monkeypatch.setattr(progress, "FIRST_LINE_S", 0.0)
    monkeypatch.setattr(runner, "REPEAT_S", 0.01)
    execute(config.load([*PUSHING, f"results_dir={tmp_path}"]), quiet=False)
    lines = capsys.readouterr().err.splitlines()
    assert "custom: 0/1 cells; now reference of pushing" in lines[0]
    assert "bench-progress" not in {thread.name for thread in threading.enumerate()}


def test_references_are_counted_while_they_are_computed(tmp_path, monkeypatch):
    lines = []
    monkeypatch.setattr(launcher, "BATCH_S", -1.0)  # otherwise answers of quick tasks come together
    monkeypatch.setattr(progress.Progress, "working", lambda self, text: lines.append(text))
    execute(config.load([*PUSHING, "sweep.sigma=[0.1,0.2]", f"results_dir={tmp_path}"]), quiet=True)
    counted = [line for line in lines if line.startswith("reference of pushing")]
    assert counted[0].endswith("(0 of 2 references done)")
    assert any(line.endswith("(1 of 2 references done)") for line in counted)
    assert not any("references done" in line for line in lines if not line.startswith("reference"))
