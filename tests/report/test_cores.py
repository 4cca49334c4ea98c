"""Tasks in forked processes: results, errors, workers that are killed, and processes that must not be forked."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.model import blocks
from bench.report.cores import run_tasks

linux = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")


def test_one_core_does_all_in_order(monkeypatch):
    monkeypatch.setattr(blocks, "cores", lambda: 1)
    done = []
    assert run_tasks([lambda i=i: done.append(i) or i * i for i in range(5)]) == [0, 1, 4, 9, 16]
    assert done == list(range(5))


HEAD = """
import os, signal, sys, time
from pathlib import Path
from bench.model import blocks
from bench.report.cores import run_tasks
blocks.cores = lambda: 3
own = os.getpid()
signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where the tests were started
"""


def ran(code: str, timeout: float = 30.0) -> str:
    """Return what a process of one thread prints; the tests' own process has more threads."""
    done = subprocess.run(
        [sys.executable, "-c", HEAD + code], capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.stderr == "", done.stderr
    return done.stdout.strip()


@linux
def test_results_come_in_the_order_of_the_tasks_from_several_processes():
    code = """
found = run_tasks([lambda i=i: time.sleep(0.2) or (i, os.getpid()) for i in range(6)])
print([i for i, _ in found], len({pid for _, pid in found}) > 1, any(pid == own for _, pid in found))
"""
    assert ran(code) == "[0, 1, 2, 3, 4, 5] True False"


@linux
def test_results_larger_than_a_pipe_arrive():
    assert ran("print(sum(map(len, run_tasks([lambda: time.sleep(0.1) or b'x' * 10**6] * 4))))") == "4000000"


@linux
def test_the_first_error_in_order_is_raised_as_it_was():
    code = """
def fail(text):
    time.sleep(0.2)
    raise KeyError(text)
try:
    run_tasks([lambda: time.sleep(0.3), lambda: fail("first"), lambda: fail("second")])
except KeyError as error:
    print(error)
"""
    assert ran(code) == "'first'"


@linux
def test_tasks_of_a_killed_worker_are_rerun_here():
    code = """
def work(i):
    if os.getpid() != own:
        os.kill(os.getpid(), 9)
    time.sleep(0.1)
    return i, os.getpid() == own
print(run_tasks([lambda i=i: work(i) for i in range(6)]))
"""
    assert ran(code) == str([(i, True) for i in range(6)])


@linux
def test_a_task_whose_error_cannot_be_pickled_is_rerun_here():
    code = """
class Own(Exception):
    def __init__(self, a, b): super().__init__(a)
def fail():
    time.sleep(0.2)
    raise Own("said", 2)
try:
    run_tasks([fail, fail, fail])
except Own as error:
    print(error)
"""
    assert ran(code) == "said"


@linux
def test_a_result_that_cannot_be_pickled_is_computed_here():
    assert (
        ran("print([function() for function in run_tasks([lambda i=i: lambda: i for i in range(3)])])") == "[0, 1, 2]"
    )


@linux
def test_a_worker_may_run_tasks_in_workers_of_its_own():
    code = """
def inner(i):
    return sum(run_tasks([lambda j=j: i * j for j in range(4)]))
print(run_tasks([lambda i=i: inner(i) for i in range(4)]))
"""
    assert ran(code) == "[0, 6, 12, 18]"


@linux
def test_no_worker_outlives_the_tasks_and_no_descriptor_is_left():
    code = """
before = len(os.listdir("/proc/self/fd"))
run_tasks([lambda: 1] * 4)
try:
    os.waitpid(-1, 0)
except ChildProcessError:
    print("no child", len(os.listdir("/proc/self/fd")) - before)
"""
    assert ran(code) == "no child 0"


@linux
def test_a_worker_ends_with_its_parent(tmp_path: Path):
    code = f"""
def work():
    (Path({str(tmp_path)!r}) / str(os.getpid())).touch()
    time.sleep(60)
run_tasks([work] * 3)
"""
    process = subprocess.Popen([sys.executable, "-c", HEAD + code])
    until = time.monotonic() + 20
    while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < until:
        time.sleep(0.05)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    assert len(workers) == 3
    process.kill()
    process.wait()
    until = time.monotonic() + 10
    while any(_alive(worker) for worker in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(_alive(worker) for worker in workers)


def _alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@linux
@pytest.mark.parametrize(
    "begun", ["import threading; threading.Thread(target=time.sleep, args=(1,), daemon=True).start()", "import jax"]
)
def test_nothing_is_forked_beside_other_threads(begun):
    code = f"""
{begun}
print({{os.getpid() == own for _ in range(3)}} == set(run_tasks([lambda: time.sleep(0.05) or os.getpid() == own] * 4)))
"""
    assert ran(code) == "True"


SLOW_START = """
from multiprocessing import process
start = process.BaseProcess.start
process.BaseProcess.start = lambda self: (start(self), time.sleep(0.3))
"""
"""The first worker is at work, and sends its interrupt, while the second one is started."""


@linux
@pytest.mark.parametrize("slow", ["", SLOW_START])
def test_an_interrupt_ends_the_workers_and_is_raised(slow):
    code = f"""{slow}
def work():
    os.kill(own, signal.SIGINT)
    time.sleep(5)
began = time.monotonic()
try:
    run_tasks([work] * 3)
except KeyboardInterrupt:
    print("interrupted", time.monotonic() - began < 4)
try:
    os.waitpid(-1, 0)
except ChildProcessError:
    print("no child")
"""
    assert ran(code) == "interrupted True\nno child"


@linux
def test_processes_that_a_task_leaves_running_end_with_it():
    code = """
import subprocess
import psutil
def leave():
    time.sleep(0.2)
    return subprocess.Popen(["sleep", "613"], start_new_session=True).pid
left = run_tasks([leave, leave])
time.sleep(0.2)
print(sum(psutil.pid_exists(pid) and psutil.Process(pid).status() != "zombie" for pid in left))
"""
    assert ran(code) == "0"
