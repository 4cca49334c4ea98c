"""Run a command, and fail if it takes more processor seconds than a ceiling: ``python tests/ceiling.py SECONDS COMMAND...``.

The seconds are those of the command and of all processes that it waits for, so that other load does not count.
"""

import resource
import subprocess
import sys

ceiling, *command = sys.argv[1:]
status = subprocess.call(command)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
seconds = usage.ru_utime + usage.ru_stime
print(f"{seconds:.0f} s of processor time, ceiling {ceiling} s")
if not status and seconds > float(ceiling):
    status = f"{' '.join(command)} takes too long: make its tests shorter, or mark those for wider inputs as slow"
sys.exit(status)
