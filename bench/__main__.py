"""``python -m bench``."""

import contextlib
import logging
import os
import sys
import threading
import traceback

from bench.cli import main
from bench.model import guard


def command() -> None:
    """Run one command and end the process with its status, even if plugins have left threads or processes running."""
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


if __name__ == "__main__":
    command()
