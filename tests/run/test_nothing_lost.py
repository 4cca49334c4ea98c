"""Rows that must not be lost, changed or blamed: studies under one name, wrong clocks, full pipes, late deaths."""

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection

import pytest
from bench.plugins.studies.bias_variance.columns import COLUMNS
from trees import bench, hearing_signals, processes_in, wait_for

from bench.cli import main
from bench.errors import UserError
from bench.experiment.experiment import Execution
from bench.host.guard import temporary_file
from bench.run import files
from bench.run.pool import Pool, _Worker
from bench.run.store import Store

TINY = ["scenes=[heaviside]", "backends=[numpy]", "samples=8", "repeats=4", "timing=false", "workers=0", "--quiet"]
FOBG = [*TINY, "estimators=[fobg]"]


def row(key="a", **values):
    return COLUMNS.blank() | {"key": key, "status": "ok", "study": "bias_variance", **values}


# ---------------------------------------------------------------------------------------------------- one directory


@pytest.mark.parametrize("verb", ["run", "plan", "report"])
def test_a_directory_of_another_study_is_refused_and_left_alone(tmp_path, capsys, verb):
    store = Store(tmp_path / "custom", COLUMNS)
    store.prepare()
    store.append(row(study="growth", rate_max=2.0))
    held = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert main([verb, *FOBG, f"results_dir={tmp_path}"]) == 2
    said = capsys.readouterr().err
    assert "holds rows of study growth, and this is study bias_variance" in said
    assert "name=" in said
    assert held == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_a_study_that_came_and_went_meanwhile_is_seen(tmp_path):
    mine, other = (Store(tmp_path, COLUMNS, study) for study in ("bias_variance", "growth"))
    assert mine.load().empty
    other.prepare()
    other.append(row(study="growth"))
    other.compact()
    with pytest.raises(UserError, match="holds rows of study growth"):
        mine.prepare()
    other.compact()
    assert [path.name for path in tmp_path.glob("*.*")] == ["rows.parquet"]


@pytest.mark.parametrize(
    "old",
    [
        {"sequence": 1.0, "stored_at": 4e9},
        {},
        *({"sequence": n, "stored_at": 4e9} for n in (math.inf, 1e300, -5.0, math.nan)),
    ],
)
def test_the_row_that_is_stored_last_wins_wherever_it_lies_and_however_the_others_are_dated(tmp_path, old):
    (tmp_path / "pending").mkdir()
    undated = {name: value for name, value in row(bias=1.0).items() if name not in ("stored_at", "sequence")}
    content = json.dumps([undated | old]).encode()
    (tmp_path / "pending" / f"{hashlib.sha256(content).hexdigest()}.json").write_bytes(content)
    for bias in (2.0, 3.0, 4.0):
        Store(tmp_path, COLUMNS).append(row(bias=bias))
        assert list(Store(tmp_path, COLUMNS).load()["bias"]) == [bias]
        if bias > 2.0:
            Store(tmp_path, COLUMNS).compact()
            assert list(Store(tmp_path, COLUMNS).load()["bias"]) == [bias]


# ------------------------------------------------------------------------------------------------------------- files


def test_a_run_removes_the_half_written_files_of_killed_runs(tmp_path):
    part = f".x-bench-{'0' * 32}"
    for place in ("custom", "custom/pending", "references"):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        for name in (part, f"{part[:-1]}1", ".mine"):
            (tmp_path / place / name).write_text("half")
        os.utime(tmp_path / place / part, (0, 0))
        os.utime(tmp_path / place / ".mine", (0, 0))
    assert main([*FOBG, f"results_dir={tmp_path}"]) == 0
    assert len(list(tmp_path.rglob(".x-*1"))) == len(list(tmp_path.rglob(".mine"))) == 3
    assert not list(tmp_path.rglob(part))


def test_the_disk_is_told_to_empty_its_cache_where_fsync_does_not(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(files.fcntl, "F_FULLFSYNC", 51, raising=False)
    monkeypatch.setattr(files.fcntl, "fcntl", lambda descriptor, what: asked.append(what))
    files.write_whole(tmp_path / "x", b"1")
    assert asked == [51, 51]  # the file and its folder


# ----------------------------------------------------------------------------------------------------------- workers


def framed(text):
    return len(text).to_bytes(4, "big") + text


MALFORMED = {
    "noise": b"garbage" * 10,
    "length": (1 << 40).to_bytes(8, "big"),
    "json": framed(b"{"),
    "event": framed(b'{"event": "of no kind"}'),
    "result": framed(b'{"event": "answer", "result": 7, "seconds": "x"}'),
    "seconds": framed(b'{"event": "answer", "result": {"status": "ok"}}'),
    "time": framed(b'{"event": "answer", "result": {"status": "ok"}, "seconds": NaN}'),
    "status": framed(b'{"event": "answer", "result": {}, "seconds": 1.0}'),
    "state": framed(b'{"event": "answer", "result": {"status": "fine"}, "seconds": 1.0}'),
    "reason": framed(b'{"event": "answer", "result": {"status": "error", "reason": 7}, "seconds": 1.0}'),
    "deep": framed(b'{"event": ' + b"[" * 100_000),
}


def _is_socket(descriptor):
    import stat

    try:
        return stat.S_ISSOCK(os.fstat(descriptor).st_mode)
    except OSError:
        return False


class Handler:
    """Does what an item says, in the worker."""

    def __init__(self, argument):
        pass

    def prepare(self, item):
        pass

    def __call__(self, item):
        what = item[0]
        if what == "dies late":
            import threading

            threading.Timer(0.15, os._exit, [3]).start()
        elif what == "dies":
            os._exit(4)
        elif what == "hangs":
            time.sleep(1000)
        elif what == "malformed":
            descriptor = int(next(d for d in os.listdir("/dev/fd") if _is_socket(int(d))))
            os.write(descriptor, MALFORMED[item[1]])
        elif what == "slow":
            time.sleep(0.4)
        elif what == "prints":
            print(item[1], flush=True)
        elif what == "taints":
            self.is_tainted = True
        return {"status": "ok", "pid": os.getpid()}


def answers(items, limits=None, **more):
    with Pool(1, Handler, None, limits or Execution(), folders=(), **more) as pool:
        found = [answer for some in pool.run([items]) for answer in some]
    return {str(answer.item[0]): answer.result for answer in found}, found


@pytest.mark.slow
def test_a_late_death_is_not_blamed_on_the_next_cell():
    results, found = answers([("dies late",), ("slow",), ("sound",)])
    assert len(found) == 3
    assert {result["status"] for result in results.values()} == {"ok"}


@pytest.mark.slow
def test_a_cell_that_dies_twice_is_blamed_and_its_neighbours_are_not():
    results, _ = answers([("sound",), ("dies",), ("other",)])
    assert results["dies"]["status"] == "crashed"
    assert "exit status 4, in two workers" in results["dies"]["reason"]
    assert results["sound"]["status"] == results["other"]["status"] == "ok"


@pytest.mark.slow
def test_large_items_behind_a_hanging_one_do_not_hold_up_the_clock():
    big = "x" * 600_000
    started = time.monotonic()
    results, found = answers(
        [("sound", big), ("hangs", big), *((f"more{i}", big) for i in range(6))], Execution(timeout=10.0)
    )
    assert time.monotonic() - started < 300  # a hanging cell sleeps for 1,000 s
    assert results["hangs"]["status"] == "timeout"
    assert len(found) == 8


@pytest.mark.parametrize("content", ["noise", pytest.param("length", marks=pytest.mark.slow)])
def test_a_malformed_message_counts_as_a_crash_of_its_cell(content):
    results, _ = answers([("sound",), ("malformed", content), ("other",)])
    assert results["malformed"]["status"] == "crashed"
    assert "malformed message, in two workers" in results["malformed"]["reason"]
    assert results["sound"]["status"] == results["other"]["status"] == "ok"


@pytest.mark.parametrize("content", sorted(MALFORMED.keys() - {"noise", "length"}))
def test_a_message_that_is_no_answer_is_malformed(content):
    worker = _Worker(None, None, None, None, "", item="item")
    with pytest.raises((ValueError, LookupError, TypeError, RecursionError)):
        worker._read(MALFORMED[content][4:])
    assert worker.item


@pytest.mark.slow
def test_a_worker_that_a_plugin_has_changed_is_replaced_and_nothing_is_blamed():
    results, found = answers([("sound",), ("taints",), ("other",), ("more",), ("taints", 2), ("last",)])
    assert len(found) == 6
    assert {result["status"] for result in results.values()} == {"ok"}
    places = [answer.result["pid"] for answer in found]
    assert [places.index(place) for place in places] == [0, 0, 2, 2, 2, 5]


@pytest.mark.slow
def test_a_worker_that_ran_code_from_outside_gets_no_other_group():
    """Tens run the same code from outside, and 0 to 9 run none."""
    groups = [[(10,), (11,)], [(1,), (2,)], [(20,)], [(12,)], [(3,)]]
    with Pool(
        1, Handler, None, Execution(), outside=lambda item: frozenset([item[0] // 10] if item[0] > 9 else [])
    ) as pool:
        place = {answer.item[0]: answer.result["pid"] for some in pool.run(groups) for answer in some}
    assert sorted(place) == [1, 2, 3, 10, 11, 12, 20]
    assert place[10] == place[11] == place[12]
    assert place[10] not in (place[1], place[20], place[3])
    assert place[20] != place[3]


def test_output_belongs_to_the_item_that_printed_it():
    _, found = answers([("prints", f"output {i}") for i in range(40)] + [("sound",)])
    assert [answer.output for answer in found] == [f"output {i}" for i in range(40)] + [""]


def test_messages_before_a_malformed_one_still_count():
    import socket

    ours, theirs = socket.socketpair()
    with theirs:
        answer = b'{"event": "answer", "result": {"status": "ok"}, "seconds": 1.0}'
        theirs.sendall(framed(b'{"event": "started"}') + framed(answer) + b"garbage" * 10)
        worker = _Worker(None, Connection(ours.detach()), temporary_file(), None, "", item="item")
        assert [one.item for one in worker.receive()] == ["item"]
        assert worker.fault == "sent a malformed message"
        worker.close()


def test_an_open_connection_without_messages_is_not_a_fault():
    import socket

    ours, theirs = socket.socketpair()
    worker = _Worker(None, Connection(ours.detach()), temporary_file(), None, "")
    assert worker.receive() == []
    assert not worker.fault
    theirs.close()
    assert worker.receive() == []
    assert worker.fault == "closed its connection"
    worker.close()


HELD = """
import ctypes, os, subprocess, sys
from bench.experiment.experiment import Execution
from bench.run.pool import _Worker, Pool

class Holds:
    def __init__(self, argument):
        pass
    def prepare(self, item):
        pass
    def __call__(self, item):
        subprocess.Popen(["sleep", "600"], start_new_session=True)
        print("at work", file=open(item, "w"))
        ctypes.PyDLL(None).sleep(600)  # in C, with the interpreter lock
        return {"status": "ok"}

if __name__ == "__main__":
    import held
    with Pool(1, held.Holds, None, Execution()) as pool:
        list(pool.run([[sys.argv[1]]]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc")
def test_workers_that_hold_the_interpreter_lock_end_with_their_run(tmp_path):
    (tmp_path / "held.py").write_text(HELD)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    run = subprocess.Popen([sys.executable, str(tmp_path / "held.py"), "begun"], cwd=tmp_path, env=environment)

    wait_for(lambda: (tmp_path / "begun").exists())
    assert len(processes_in(tmp_path)) >= 4  # the run, its reaper, the worker and what it started
    (reaper,) = (process for process in processes_in(tmp_path) if "bench/run/reaper.py" in " ".join(process.cmdline()))
    reaper.suspend()
    run.kill()
    run.wait()
    wait_for(lambda: not processes_in(tmp_path), 5.0)


COLLECTED = """
import gc, os, signal
from bench.cli import _stop_on_signals
from bench.host.guard import protect_process

def struck(*_):
    gc.callbacks.remove(struck)
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(10):
        pass

with _stop_on_signals():
    gc.callbacks.append(struck)
    try:
        with protect_process():
            gc.collect()
    except KeyboardInterrupt:
        print("stopped")
"""


def test_a_signal_in_the_garbage_collector_stops_the_run_after_the_cell_and_prints_nothing():
    done = subprocess.run([sys.executable, "-c", COLLECTED], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("stopped\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("times", [1, 2])
def test_signals_stop_a_run_in_peace(tmp_path, sent, times):
    seeds = ",".join(map(str, range(400)))
    words = [*FOBG[:-1], f"sweep.seed=[{seeds}]", "samples=20000", f"results_dir={tmp_path}"]
    with subprocess.Popen(hearing_signals(*words), stderr=subprocess.PIPE, text=True) as run:
        for _ in range(600):
            if list(tmp_path.glob("custom/pending/*.json")):
                break
            time.sleep(0.05)
        for _ in range(times):
            run.send_signal(getattr(signal, sent))
            time.sleep(0.005)
        try:
            said = run.communicate(timeout=300)[1]
        finally:
            run.kill()
    assert run.returncode in ((130,) if times == 1 else (130, -getattr(signal, sent)))
    assert "Traceback" not in said
    assert "KeyboardInterrupt" not in said
    assert not Store(tmp_path / "custom", COLUMNS).load().empty


MOVES = """
import os
from dataclasses import dataclass
from bench.plugins.backends.numpy import Numpy

@dataclass(frozen=True)
class Moves(Numpy):
    "Leaves the working folder, and a copy of the process, wherever it is asked."
    name = "moves"
    def __post_init__(self):
        os.fork()
    def own_refusal(self, *given):
        os.chdir({elsewhere!r})
        return super().own_refusal(*given)
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_backend_asked_for_references_moves_and_doubles_nothing(tmp_path, workers):
    for name in ("mine", "here", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "mine" / "moves.py").write_text(MOVES.format(elsewhere=str(tmp_path / "elsewhere")))
    words = ["scenes=[soft_heaviside]", *TINY[1:-2], f"workers={workers}", "reference.samples=4096", "results_dir=out"]
    done = bench(*words, f"plugins={tmp_path / 'mine'}", "estimators=[fobg]", folder=tmp_path / "here")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Written:") == 1
    assert (tmp_path / "here" / "out" / "custom" / "rows.parquet").exists()
    assert list((tmp_path / "here" / "out" / "references").glob("*.json"))
    assert not list((tmp_path / "elsewhere").iterdir())
