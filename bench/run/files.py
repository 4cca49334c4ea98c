"""Writes files that are either the old one or the new one, never a part of either."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import hashlib
import os
import platform
import re
import time
import uuid
from contextlib import suppress
from pathlib import Path

import psutil

from bench.errors import StorageError
from bench.model.parameters import remember

STALE_S = 3600.0
"""Age at which a half-written file of another machine belongs to no run."""
AT_FDCWD, RENAME_NOREPLACE = -100, 1
"""Of renameat2(2), Linux: paths from the working folder, and nothing is overwritten."""
RENAME_EXCL = 4
"""Of renamex_np(2), macOS: nothing is overwritten."""
TEMPORARY = re.compile(r"\..+-bench-([0-9a-f]{8})-(\d+)-[0-9a-f]{32}")
"""Names of files that are being written: the machine, the process, and a number of their own."""


def temporary(path: Path) -> Path:
    """Return a hidden name beside a path under which it can be written; it says whose it is, for :func:`tidy`."""
    return path.with_name(f".{path.name[:100]}-bench-{_machine()}-{os.getpid()}-{uuid.uuid4().hex}")


@remember
def _machine() -> str:
    """Return a name for what process numbers mean something on: one start of a machine, or one container."""
    try:
        where = Path("/proc/sys/kernel/random/boot_id").read_text() + os.readlink("/proc/self/ns/pid")
    except OSError:
        where = platform.node()
    return hashlib.sha256(where.encode()).hexdigest()[:8]


def tidy(directory: Path) -> None:
    """Remove half-written files that killed runs have left in a directory, itself and not below it."""
    with suppress(OSError):
        for path in directory.iterdir():
            match = TEMPORARY.fullmatch(path.name)
            if match is None:
                continue
            with suppress(OSError):
                gone = match[1] == _machine() and not psutil.pid_exists(int(match[2]))
                if gone or time.time() - path.stat().st_mtime > STALE_S:
                    path.unlink()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file at once or not at all; raises :class:`StorageError` if it cannot be written."""
    try:
        replace_file(path, content)
    except OSError as error:
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def write_all(directory: Path, contents: dict[str, str]) -> list[Path]:
    """Write texts under their names in a directory; returns their paths."""
    for name, text in contents.items():
        write_whole(directory / name, text.encode())
    return [directory / name for name in contents]


def make_directory(path: Path) -> None:
    """Make a directory and its parents; raises :class:`StorageError` if it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def replace_file(path: Path, content: bytes) -> None:
    """Write like :func:`write_whole`, but let FileNotFoundError pass: the directory may have been removed meanwhile."""
    part = temporary(path)
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            # the content must be on disk before the name points to it, or a power cut leaves an empty file
            flush(file.fileno())
        os.replace(part, path)
        sync(path.parent)
    except FileNotFoundError:
        raise
    except OSError as error:
        part.unlink(missing_ok=True)
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def place(path: Path, name: Path) -> None:
    """Give a file a name that nothing has; raises FileExistsError where something has it, and leaves both as they are.

    Where the file system has hard links, the file keeps its old name as well.
    """
    try:
        os.link(path, name)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        _rename_new(path, name)


def _rename_new(path: Path, name: Path) -> None:
    """Rename to a name that nothing has, in one step where the system can: ``os.rename`` overwrites what another run put there."""
    system, names = ctypes.CDLL(None, use_errno=True), (os.fsencode(path), os.fsencode(name))
    failed = errno.ENOSYS
    if hasattr(system, "renameat2"):
        failed = ctypes.get_errno() if system.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_NOREPLACE) else 0
    elif hasattr(system, "renamex_np"):
        failed = ctypes.get_errno() if system.renamex_np(*names, RENAME_EXCL) else 0
    if failed in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):  # the file system cannot: a look, and then the step
        failed = errno.EEXIST if os.path.lexists(name) else 0
        if not failed:
            os.rename(path, name)
    if failed:
        raise OSError(failed, os.strerror(failed), str(path), None, str(name))


def sync(directory: Path) -> None:
    """Make renames in a directory outlast a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        flush(descriptor)
    finally:
        os.close(descriptor)


def flush(descriptor: int) -> None:
    """Have the disk write what it was given: on macOS ``fsync`` stops at the drive's cache, and F_FULLFSYNC does not."""
    whole = getattr(fcntl, "F_FULLFSYNC", None)
    if whole is not None:
        with suppress(OSError):  # a network drive may not know it
            fcntl.fcntl(descriptor, whole)
            return
    os.fsync(descriptor)
