"""Writes files atomically: after a kill or a power failure a file has its old or its new content, never a part."""

from __future__ import annotations

import fcntl
import os
import re
import time
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from bench.errors import StorageError


def remove_stale(directory: Path) -> None:
    """Remove the half-written files of killed runs from a directory, but not from its subdirectories."""
    with suppress(OSError):
        for path in directory.iterdir():
            with suppress(OSError):
                # age in seconds after which a half-written file is that of a killed run
                if re.fullmatch(r"\..+-bench-[0-9a-f]{32}", path.name) and time.time() - path.stat().st_mtime > 3600.0:
                    path.unlink()


def write_whole(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write a file completely or not at all; raises :class:`StorageError` if it cannot be written. A link stays one."""
    path = path.resolve() if path.is_symlink() else path
    part = path.with_name(f".{path.name[:100]}-bench-{uuid.uuid4().hex}")
    try:
        with open(part, "wb") as file:
            file.writelines([content] if isinstance(content, bytes) else content)
            file.flush()
            # the content must be on disk before the name points to it, or a power cut leaves an empty file
            flush_to_disk(file.fileno())
        os.replace(part, path)
        # the entries of the folder too, so that the name survives a power failure
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            flush_to_disk(descriptor)
        finally:
            os.close(descriptor)
    except BaseException as error:  # also of code that makes the content
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None
        raise


def write_all(directory: Path, contents: Mapping[str, str] | Iterable[tuple[str, str | Iterable[str]]]) -> list[Path]:
    """Write files, given as their names with their texts, whole or in blocks, to a directory; returns the paths."""
    paths = []
    for name, text in contents.items() if isinstance(contents, Mapping) else contents:
        paths.append(directory / name)
        blocks = [text] if isinstance(text, str) else text
        write_whole(paths[-1], (block.encode() for block in blocks))
    return paths


def make_directory(path: Path) -> None:
    """Create a directory and its parents; raises :class:`StorageError` if it cannot be created, or is an address."""
    if str(path).partition("/")[0].endswith(":"):
        raise StorageError(f"'{path}' is an address, and results are written to a folder of this machine")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def flush_to_disk(descriptor: int) -> None:
    """Write a file to disk. On macOS ``fsync`` stops at the drive's cache, and F_FULLFSYNC does not."""
    full = getattr(fcntl, "F_FULLFSYNC", None)
    if full is not None:
        with suppress(OSError):  # a network drive may not support it
            fcntl.fcntl(descriptor, full)
            return
    os.fsync(descriptor)
