"""Waiting for a cluster: says on stderr what is waited for, and gives up after a limit."""

from __future__ import annotations

import socket
import sys
import time

from bench.errors import UserError, printable

SILENT_S = 5.0
"""Seconds after which it is said what is waited for."""
PAUSE_S = 0.5
"""Seconds between two attempts to connect."""


class Patience:
    """Counts the seconds of one wait of at most ``limit_s`` seconds; None for no limit."""

    def __init__(self, limit_s: float | None, setting: str = "") -> None:
        self._limit_s, self._setting = limit_s, setting
        self._since = time.monotonic()
        self._has_spoken = False

    def wait(self, reason: str, fix: str = "") -> None:
        """Print what is waited for, once, after 5 s; raises :class:`UserError` after the limit."""
        seconds = time.monotonic() - self._since
        if self._limit_s is not None and seconds > self._limit_s:
            hint = fix and f"; {fix}"
            raise UserError(f"{reason}; gave up after {self._limit_s:g} s ({self._setting}){hint}")
        if seconds > SILENT_S and not self._has_spoken:
            self._has_spoken = True
            end = "" if self._limit_s is None else f", for at most {self._limit_s:g} s ({self._setting})"
            print(f"bench: {reason}: waiting{end}", file=sys.stderr)


def reach(address: str, patience: Patience) -> None:
    """Wait until a TCP connection to ``HOST:PORT`` is possible.

    Raises :class:`UserError` for an unknown host, an address without a port, and after the limit.
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise UserError(f"ray.address={printable(address)} must be HOST:PORT, for example 10.0.0.1:6379")
    while True:
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
                return
        except (socket.gaierror, UnicodeError):
            raise UserError(f"ray.address={printable(address)}: no host has that name") from None
        except OSError as error:
            cause = error.strerror or "no answer"
            patience.wait(f"no Ray cluster answers at {printable(address)} ({cause})", "start one: ray start --head")
            time.sleep(PAUSE_S)
