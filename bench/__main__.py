"""``python -m bench``."""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time

from bench.errors import describe_exit
from bench.run.reaper import MARK, Reaper

CHANNEL = "BENCH_CHANNEL"
"""Environment variable of a command's process: the descriptor to which it writes its status, and its parent's id."""


def command() -> None:
    """Run one command and end with its status, even if plugins have left threads or processes running.

    The command has a process of its own, since code that it runs, such as a plugin or a user's cost, may end that process with
    any status. All processes that it has started end with it.
    """
    channel = os.environ.pop(CHANNEL, "")
    if not channel:
        os._exit(_watched())  # without waiting for threads
    from bench.cli import main
    from bench.errors import failure
    from bench.host import guard
    from bench.model import registry

    descriptor, parent = map(int, channel.split())
    os.set_inheritable(descriptor, False)
    guard.die_with(parent)
    pid = os.getpid()
    try:
        status = main()
    except MemoryError:
        print("bench: not enough memory: give the process more (4 GB suffice for most runs)", file=sys.stderr)
        status = 1
    except Exception as error:  # a bug of this package, unless code from outside has changed the process
        outside = f"; imported from outside: {', '.join(sorted(registry.IMPORTED))}" if registry.IMPORTED else ""
        print(f"bench: internal error: {failure(error)['reason']}{outside}", file=sys.stderr)
        status = 70
    guard.exit_if_forked(pid)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a plugin may have closed or replaced it
            stream.flush()
    with contextlib.suppress(OSError):
        os.write(descriptor, bytes([status]))
    sys.exit(status)


def _watched() -> int:
    """Run this command in a marked child process, and return the status that the child writes before it ends."""
    reader, writer = os.pipe()
    reaper = Reaper(adopts=True)
    variables = {MARK: reaper.mark, CHANNEL: f"{writer} {os.getpid()}"}
    child = subprocess.Popen([sys.executable, *sys.orig_argv[1:]], env=os.environ | variables, pass_fds=[writer])
    first = 0.0

    def forward(number: int, _: object) -> None:
        nonlocal first
        first = first or time.monotonic()
        # a further signal ends a command immediately, but a terminal and a parent may send the same one
        child.send_signal(number if time.monotonic() < first + 0.5 else signal.SIGKILL)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, forward)
    while child.poll() is None and not select.select([reader], [], [], 0.2)[0]:
        pass
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(1.0)  # it has written its status
    reaper.close()
    code = child.wait()
    if select.select([reader], [], [], 0)[0]:
        return os.read(reader, 1)[0]
    if first:
        return 128 + signal.SIGINT
    print(f"bench: the process ended before a verdict: {describe_exit(code)}", file=sys.stderr)
    return 3


if __name__ == "__main__":
    command()
