"""``python -m bench``."""

import atexit
import os
import sys
import threading

from bench.cli import main
from bench.model import guard

if __name__ == "__main__":
    own = os.getpid()
    status = main()
    guard.end_copies(own)
    guard.end_children()
    if any(not thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        # a thread that a plugin left running must not keep the finished command waiting
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)
    sys.exit(status)
