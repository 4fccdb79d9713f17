"""Open files for reading: one error in one line for every path that is not a readable file."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from jaxfit.errors import InputError

__all__ = ["check_folder", "check_readable", "open_file", "read_file"]

# Errors of the operating system for a read: the problem, and the action that the user can take.
_PROBLEMS = {
    errno.ENOENT: ("does not exist", "check the path"),
    errno.ENOTDIR: ("does not exist: a part of its path is a file", "check the path"),
    errno.ELOOP: ("is a symbolic link that leads back to itself", "check the links of its path"),
    errno.ENAMETOOLONG: ("has a name that is too long for this system", "check the path"),
    errno.EACCES: ("cannot be read: permission denied", "change its permissions"),
    errno.EPERM: ("cannot be read: permission denied", "change its permissions"),
}


def check_readable(path: str | Path, kind: str = "a file") -> Path:
    """Check that a path is a regular file that can be read; call this function before a library opens the path.

    Args:
        path: the file.
        kind: the expected kind of file with its article, such as ``an .npz file``, for the message.

    Returns:
        The path.

    Raises:
        InputError: the path does not exist, is not a regular file (a folder, a device, a pipe), is a cyclic symbolic
            link, has a name that is too long or that no file can have, or cannot be read.
    """
    with open_file(path, kind):
        return Path(path)


def check_folder(path: str | Path, kind: str = "a folder") -> Path:
    """Check that a path is a folder; arguments, result and errors as `check_readable`."""
    path = Path(path)
    with _read_errors(path):
        if not stat.S_ISDIR(path.stat().st_mode):
            raise InputError(path, f"is a file, not {kind}", "check the path")
    return path


@contextmanager
def open_file(path: str | Path, kind: str = "a file") -> Iterator[BinaryIO]:
    """Open a regular file for reading bytes, as a context manager; arguments and errors as `check_readable`.

    An error of the operating system in the body, such as a damaged disk, is an InputError too.
    """
    path = Path(path)
    with _read_errors(path):
        _require_file(path, path.stat().st_mode, kind)  # before the open, because devices may react to it
        # without O_NONBLOCK, opening a pipe that replaces the file now would wait for a writer
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            _require_file(path, os.fstat(descriptor).st_mode, kind)
            yield file


def read_file(path: str | Path, most_bytes: int, kind: str = "a file") -> bytes:
    """Return the bytes of a regular file of at most `most_bytes`.

    Raises:
        InputError: as `check_readable`; or the file is larger.
    """
    with open_file(path, kind) as file:
        # the size of a file may change, and is 0 for files of the operating system
        size = os.fstat(file.fileno()).st_size
        content = b"" if size > most_bytes else file.read(most_bytes + 1)
    if max(size, len(content)) > most_bytes:
        problem = f"has {max(size, len(content)):,} bytes; {kind} of jaxfit has at most {most_bytes:,}"
        raise InputError(path, problem, "check the path")
    return content


def _require_file(path: Path, mode: int, kind: str) -> None:
    if stat.S_ISDIR(mode):
        raise InputError(path, f"is a folder, not {kind}", "check the path")
    if not stat.S_ISREG(mode):
        raise InputError(path, f"is a device or a pipe, not {kind}", "check the path")


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the body to an InputError that names `path`."""
    try:
        valid = b"\0" not in os.fsencode(path)
    except UnicodeEncodeError:
        valid = False
    if not valid:
        raise InputError(path, "contains a character that no file name has", "check the path")
    try:
        yield
    except OSError as error:
        unknown = f"cannot be read: {error.strerror or error}", "check the disk or the path"
        problem, remedy = _PROBLEMS.get(error.errno or 0, unknown)
        raise InputError(path, problem, remedy) from error
