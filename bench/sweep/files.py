"""Writes files that are either the old one or the new one, never a part of either."""

from __future__ import annotations

import os
import uuid
from pathlib import Path

from bench.errors import StorageError


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
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            # the content must be on disk before the name points to it, or a power cut leaves an empty file
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync(path.parent)
    except FileNotFoundError:
        raise
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageError(f"'{path}' cannot be written: {error.strerror}") from None


def sync(directory: Path) -> None:
    """Make renames in a directory outlast a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
