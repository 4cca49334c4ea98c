"""The reaper: a process that waits until a run ends, for any reason, and then kills all processes the run has started.

A worker cannot do this itself: a plugin may hold the interpreter lock, or the worker may be stopped. On Linux the
kernel kills the workers when the run ends, but not the processes that the workers have started.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress

MARK = "BENCH_WORKER"
"""Environment variable that marks a worker and every process it starts, even in another session."""
DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl(2)."""
PASSES, PAUSE_S = 5, 0.2
"""Number of searches for marked processes, which may start others meanwhile, and pause in seconds after each search."""
READY_S = 0.02
"""Seconds between two signals to a reaper that is not ready."""


class Reaper:
    """Starts a reaper, which kills every process marked with ``mark`` when this process ends, even if it is killed.

    The reaper waits on a pipe that the system closes when this process ends.
    """

    def __init__(self, mark: str) -> None:
        environment = {name: value for name, value in os.environ.items() if name != MARK}
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, mark, chr(0x1F).join(sys.path)],  # without importing the package
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
            start_new_session=True,
        )  # fmt: skip
        self._is_ready = False

    def wait_until_ready(self) -> None:
        """Wait until the end of this process would resume a stopped reaper; until then, a stopped reaper is resumed here."""
        assert self._process.stdout is not None
        poll = select.poll()
        poll.register(self._process.stdout, select.POLLIN)
        while not self._is_ready and self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
            self._is_ready = bool(poll.poll(1000 * READY_S))

    def close(self) -> None:
        """End the reaper's process. End the workers first."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


def main() -> None:
    """Wait until standard input is closed, then kill all processes whose mark starts with the first argument."""
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_IGN)
    with suppress(OSError, AttributeError):  # on Linux the end of the run resumes this process if it is stopped
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGCONT, 0, 0, 0)
    with suppress(OSError):
        os.write(1, b"\n")
    sys.stdin.buffer.read()
    for _ in range(PASSES):
        kill_marked_processes(sys.argv[1])
        time.sleep(PAUSE_S)


def kill_marked_processes(mark: str) -> None:
    """Kill all other processes whose mark is ``mark`` or starts with it."""
    import psutil

    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.pid != os.getpid() and process.environ().get(MARK, "").startswith(mark):
                process.kill()


if __name__ == "__main__":
    sys.path[:] = sys.argv.pop().split(chr(0x1F))
    main()
