"""The reaper: a process that waits until a run ends, for any reason, and then kills all processes the run has started.

A worker cannot do this itself: a plugin may hold the interpreter lock, or the worker may be stopped. On Linux the
kernel kills the workers when the run ends, but not the processes that the workers have started.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress

MARK = "BENCH_MARK"
"""Environment variable that marks a process and every process that it starts, even in another session."""
DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""
PASSES, PAUSE_S = 5, 0.2
"""Most searches for marked processes, which may start others meanwhile, and the reaper's pause in seconds after each."""


class Reaper:
    """Kills every process whose environment has its ``mark`` when it is closed or this process ends, even if it is killed.

    The reaper waits on a pipe that the system closes when this process ends. If this process is marked itself, the reaper of
    its mark does that too: marks begin with the mark of the process that made them.
    """

    def __init__(self) -> None:
        self.mark = f"{os.environ.get(MARK, '')}{uuid.uuid4().hex}"
        self._process: subprocess.Popen[bytes] | None = None
        if MARK not in os.environ:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", __file__, self.mark, chr(0x1F).join(sys.path)],  # without the package
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip

    def close(self) -> None:
        """Kill the marked processes, then the reaper's own."""
        for _ in range(PASSES):
            if not kill_marked_processes(self.mark):
                break
        if self._process is not None:
            with self._process as process:  # closes its pipe
                process.kill()


def main() -> None:
    """Wait until standard input is closed, then kill all processes whose mark starts with the first argument."""
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_IGN)
    with suppress(OSError, AttributeError):  # on Linux the end of the run resumes this process if it is stopped
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGCONT, 0, 0, 0)
    sys.stdin.buffer.read()
    for _ in range(PASSES):
        kill_marked_processes(sys.argv[1])
        time.sleep(PAUSE_S)


def kill_marked_processes(mark: str) -> int:
    """Kill all other processes whose mark is ``mark`` or starts with it, and return their number."""
    n_killed = 0
    for pid, given in _marked_processes():
        if pid != os.getpid() and given.startswith(mark):
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
                n_killed += 1
    return n_killed


def _marked_processes() -> Iterator[tuple[int, str]]:
    """Yield the id and the mark of each process that has one and may be read."""
    if not os.path.exists("/proc/self/environ"):
        import psutil  # required by the package where there is no /proc

        for process in psutil.process_iter():
            with suppress(psutil.Error, KeyError):
                yield process.pid, process.environ()[MARK]
        return
    for pid in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
            for entry in file.read().split(b"\0"):
                if entry.startswith(f"{MARK}=".encode()):
                    yield int(pid), entry.partition(b"=")[2].decode(errors="replace")


if __name__ == "__main__":
    sys.path[:] = sys.argv.pop().split(chr(0x1F))
    main()
