"""The reaper: a process that waits until a run ends, for any reason, and then kills all processes the run has started.

A worker cannot do this itself: a plugin may hold the interpreter lock, or the worker may be stopped. On Linux the
kernel kills the workers when the run ends, but not the processes that the workers have started. Processes are found by a
mark in their environment. Others, with an environment of their own, are found as descendants: the process of a command
adopts them when their parents end (Linux), and the reaper looks for them every second, in case that process is killed.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress

MARK = "BENCH_MARK"
"""Environment variable that marks a process and every process that it starts, even in another session."""
PASSES = 5
"""Most searches for marked processes, which may start others meanwhile."""


class Reaper:
    """Kills every process whose environment has its ``mark`` when it is closed or this process ends, even if it is killed.

    With ``adopts``, all descendants of this process too.

    The reaper waits on a pipe that the system closes when this process ends. If this process is marked itself, the reaper of
    its mark does that too: marks begin with the mark of the process that made them.
    """

    def __init__(self, adopts: bool = False) -> None:
        self.adopts = adopts
        if adopts:
            with suppress(OSError, AttributeError):
                # PR_SET_CHILD_SUBREAPER of prctl(2)
                ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)
        self.mark = f"{os.environ.get(MARK, '')}{uuid.uuid4().hex}"
        self._process: subprocess.Popen[bytes] | None = None
        if MARK not in os.environ:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-I",
                    "-S",
                    __file__,
                    self.mark,
                    "adopts" * adopts,
                    chr(0x1F).join(sys.path),
                ],  # without the package
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )

    def close(self) -> None:
        """Kill the marked processes, and the descendants if this process adopts them, then the reaper's own."""
        for _ in range(PASSES):
            if not kill_marked_processes(self.mark) + (self.adopts and self._kill_descendants()):
                break
        if self._process is not None:
            with self._process as process:  # closes its pipe
                process.kill()

    def _kill_descendants(self) -> int:
        try:
            import psutil
        except ModuleNotFoundError:  # installed without sweeps: marks alone
            return 0
        n_killed = 0
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                if child.status() != psutil.STATUS_ZOMBIE and child.pid != (self._process and self._process.pid):
                    child.kill()
                    n_killed += 1
        return n_killed


def main() -> None:
    """Wait until standard input is closed, then kill all processes whose mark starts with the first argument.

    With the second argument ``adopts``, also all that were descendants of the process that started this one.
    """
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_IGN)
    with suppress(OSError, AttributeError):  # on Linux the end of the run resumes this process if it is stopped
        # PR_SET_PDEATHSIG of prctl(2)
        ctypes.CDLL(None).prctl(1, signal.SIGCONT, 0, 0, 0)
    parent, found = os.getppid(), set()
    # seconds between searches for descendants while the run goes on
    while not select.select([sys.stdin], [], [], 1.0)[0]:
        if sys.argv[2] and os.getppid() == parent:
            with suppress(Exception):  # also without psutil, which the plain install does not bring: marks alone
                import psutil  # not in commands of less than a second

                found |= {*psutil.Process(parent).children(recursive=True)}
    for _ in range(PASSES):
        kill_marked_processes(sys.argv[1])
        for process in found:
            with suppress(Exception):  # it has ended
                if process.pid != os.getpid():
                    process.kill()  # psutil spares a later process of the same id
        time.sleep(0.2)


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
