"""``python -m bench``."""

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
import traceback
from functools import partial

from bench.cli import main
from bench.model import guard
from bench.run.pool import describe_exit

JUDGES = ("check", "claims", "compare", "examine", "gradcheck")
"""The commands whose status is a verdict on a user's code, which may end the process that runs it with any status."""
NO_VERDICT = 3
"""The status of a command that ended without a verdict."""
VERDICT = "BENCH_VERDICT"
"""Environment variable with the descriptor to which the process of a verdict writes its status."""
FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def command() -> None:
    """Run one command and end the process with its status, even if plugins have left threads or processes running.

    A command that judges runs in a child process: the code that it judges may end that process with any status, and
    without a verdict the status is :data:`NO_VERDICT`.
    """
    verdict = os.environ.pop(VERDICT, "")
    if not verdict and sys.argv[1:2] and sys.argv[1] in JUDGES:
        sys.exit(_judged())
    if verdict:
        os.set_inheritable(int(verdict), False)
    pid = os.getpid()
    try:
        status = main()
    except MemoryError:
        print("bench: not enough memory: give the process more (4 GB suffice for most runs)", file=sys.stderr)
        status = 1
    except Exception:  # a bug of this package
        traceback.print_exc()
        status = 1
    guard.exit_if_forked(pid)
    if verdict:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        with contextlib.suppress(OSError):  # the code that is judged may have closed it
            os.write(int(verdict), bytes([status]))
    guard.kill_children()
    if all(thread.daemon or thread is threading.main_thread() for thread in threading.enumerate()):
        sys.exit(status)
    # sys.exit would wait for the other threads, and a thread of a plugin may never end. This package needs no cleanup at
    # exit: its files and temporary folders are closed when a command returns
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a plugin may have closed or replaced it
            stream.flush()
    os._exit(status)


def _judged() -> int:
    """Run this command in a child process, and return the status that the child tells before it ends.

    The child is the leader of a process group, which is killed after its end.
    """
    reader, writer = os.pipe()
    child: subprocess.Popen[bytes] | None = None

    def forward(number: int, _: object) -> None:
        if child is not None:
            child.send_signal(number)

    for number in FORWARDED:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, forward)
    child = subprocess.Popen(
        [sys.executable, *sys.orig_argv[1:]], env=os.environ | {VERDICT: str(writer)}, pass_fds=[writer],
        # a process group in the background cannot read from a terminal
        stdin=subprocess.DEVNULL if os.isatty(0) else None, process_group=0,
        preexec_fn=partial(guard.die_with, os.getpid()),
    )  # fmt: skip
    code = child.wait()
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, signal.SIGKILL)
    os.set_blocking(reader, False)
    with contextlib.suppress(BlockingIOError):
        return os.read(reader, 1)[0]
    if -code in FORWARDED:
        return 128 - code
    print(f"bench: the process ended before a verdict: {describe_exit(code)}", file=sys.stderr)
    return NO_VERDICT


if __name__ == "__main__":
    command()
