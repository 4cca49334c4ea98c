"""Kills what a run has started once the run is gone, however it went: a process that does nothing else.

A worker cannot see to it by itself: a plugin may hold the interpreter lock, or the worker may be stopped. On Linux the
kernel kills workers with their run as well, but not what these have started.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

MARK = "BENCH_WORKER"
"""Environment variable that marks all processes started by a worker, wherever they have gone."""
AGAIN_S = 0.2
"""Seconds after which it looks once more, for processes that were started meanwhile."""


class Guardian:
    """The other end of a pipe that closes when this process ends, in whichever way."""

    def __init__(self, mark: str) -> None:
        environment = {name: value for name, value in os.environ.items() if name != MARK}
        code = "import sys; sys.path[:] = sys.argv.pop().split(chr(0x1f)); from bench.run.reaper import main; main()"
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-c", code, mark, chr(0x1F).join(sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment,
            start_new_session=True,
        )  # fmt: skip

    def dismiss(self) -> None:
        """End it, after the workers."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()


def main() -> None:
    """Wait for the end of standard input, then kill all processes whose mark starts with the one given."""
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_IGN)
    sys.stdin.buffer.read()
    for _ in range(5):
        kill_marked(sys.argv[1])
        time.sleep(AGAIN_S)


def kill_marked(mark: str) -> None:
    """Kill the other processes whose mark is this one or starts with it."""
    import psutil

    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.pid != os.getpid() and process.environ().get(MARK, "").startswith(mark):
                process.kill()
