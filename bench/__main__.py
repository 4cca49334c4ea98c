"""``python -m bench``."""

import atexit
import os
import sys
import threading
import traceback

from bench.cli import main
from bench.model import guard


def command() -> None:
    """Run one command and end the process with its status, whatever plugins have left running in it."""
    own = os.getpid()
    try:
        status = main()
    except Exception:  # a fault of this package: told in full, and the command ends all the same
        traceback.print_exc()
        status = 1
    guard.exit_if_forked(own)
    guard.kill_children()
    if any(not thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        # a thread that a plugin left running must not keep the finished command waiting
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    command()
