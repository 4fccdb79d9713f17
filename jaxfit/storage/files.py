"""Files and folders written whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from jaxfit.errors import InputError

__all__ = [
    "check_new_file",
    "check_replaceable",
    "check_writable",
    "new_file",
    "new_folder",
    "write_whole",
]

# What the operating system may answer to a write, and what the user can do about it.
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EDQUOT: "free some of your quota or choose another place",
    errno.EFBIG: "choose a file system that takes files of this size",
    errno.EROFS: "choose a place that can be written to",
    errno.EACCES: "change its permissions or choose a place that you can write to",
    errno.EPERM: "change its permissions or choose a place that you can write to",
    errno.EBUSY: "it is a mount point or in use: choose a folder inside it",
    errno.EIO: "check the disk or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "choose another place",
    errno.ENOTDIR: "a part of its path is a file: choose another place",
    errno.EEXIST: "a part of its path is a file: choose another place",
    errno.ENOTEMPTY: "something else wrote there meanwhile: choose another place",
}


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Turns what the operating system refuses into one InputError that names ``path``."""
    try:
        yield
    except OSError as error:
        if error.errno not in _REMEDIES:
            raise
        problem = f"cannot be written: {os.strerror(error.errno)}"
        raise InputError(path, problem, _REMEDIES[error.errno]) from error


@contextmanager
def _parents(path: Path) -> Iterator[None]:
    """Makes the folders above ``path``; those it made are removed again where the body fails."""
    missing = [parent for parent in path.parents if not parent.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for parent in missing:
            try:
                parent.rmdir()
            except OSError:  # not made after all, or in use by someone else meanwhile
                break
        raise


def _temporary(path: Path, suffix: str) -> Path:
    # a sibling, so that the rename stays within one file system
    return path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}{suffix}")


def _sync(path: Path) -> None:
    """Asks for ``path`` (a file or a folder's list of names) to be on the disk before going on."""
    if path.is_dir():
        # not every system opens folders, and not every file system syncs them
        with suppress(OSError):
            _sync_descriptor(os.open(path, os.O_RDONLY))
    else:
        _sync_descriptor(os.open(path, os.O_RDWR))


def _sync_descriptor(descriptor: int) -> None:
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: str | Path, content: bytes | Callable[[BinaryIO], Any]) -> None:
    """Write one file, whole or not at all, as ``new_file`` does.

    Args:
        path: the file; an existing one is replaced.
        content: its bytes, or a function that writes them to the binary file it is given.

    Raises:
        InputError: as ``new_file``.
    """
    with new_file(path) as part, part.open("xb") as file:
        if callable(content):
            content(file)
        else:
            file.write(content)


@contextmanager
def new_file(path: str | Path) -> Iterator[Path]:
    """A file that appears whole or not at all.

    ``with new_file("out.mp4") as part:`` gives the name of a temporary sibling, which the body makes. When
    the body ends, it goes onto the disk and only then to its name, so that a reader never sees half a file
    and an older file of that name survives a failure. Missing folders above are made.

    Args:
        path: the file; an existing one is replaced.

    Raises:
        InputError: ``path`` is a folder or a device, or the system refuses the write (disk full, quota,
            read-only, permissions).
    """
    path = Path(path).resolve()  # through a symbolic link, which should stay one
    if path.exists() and not path.is_file():
        raise InputError(path, "is a folder or a device, not a file", "choose another name")
    part = _temporary(path, ".part")
    with _write_errors(path), _parents(path):
        try:
            yield part
            _sync(part)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        _sync(path.parent)


@contextmanager
def new_folder(path: str | Path, overwrite: bool = False, marker: str | None = None) -> Iterator[Path]:
    """A folder that appears whole or not at all.

    ``with new_folder("out") as folder:`` gives a temporary sibling to write into; it takes its name when the
    body ends, and is removed when the body fails. An older folder is replaced only after the new one is
    complete. (A power cut between the two renames leaves the older one under ``.out.<hex>.old``.)

    Args:
        path: the folder; missing folders above are made.
        overwrite: replace a folder that holds something.
        marker: name of a file that every folder of this kind holds. A folder without it is not replaced even
            with ``overwrite``: it would be somebody's home.

    Raises:
        InputError: the folder holds results already, is no folder, lacks the ``marker``, is the current folder or
            one above it, or the system refuses the write (disk full, quota, read-only, permissions).
    """
    path = Path(path).resolve()
    check_replaceable(path, overwrite, marker)
    part = _temporary(path, ".part")
    with _write_errors(path), _parents(path):
        try:
            part.mkdir()
            yield part
            for entry in [*part.rglob("*"), part]:
                _sync(entry)
            check_replaceable(path, overwrite, marker)  # once more: the body may have taken hours
            _take_place(part, path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        _sync(path.parent)


def check_replaceable(path: str | Path, overwrite: bool, marker: str | None = None) -> None:
    """Raise `new_folder`'s InputError where it would refuse ``path``: before long work rather than after it."""
    path = Path(path).resolve()
    if _holds_current(path):  # renamed over, it would leave the shell in a folder that is gone
        raise InputError(path, "is the folder you are in, or one above it", "name a folder inside it")
    check_writable(path)
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(path, "is a file, not a folder", "choose another --out")
    with _write_errors(path):
        if not any(path.iterdir()):
            return
    if not overwrite:
        raise InputError(path, "holds results already", "choose another --out or pass --overwrite")
    if marker is not None and not (path / marker).is_file():
        problem = f"holds files, but no {marker}, so it is not a folder of results and is left alone"
        raise InputError(path, problem, "choose another --out")


def check_new_file(path: Path, overwrite: bool) -> None:
    """Raise InputError where a file to write would take the place of something that it may not."""
    if path.exists() and not path.is_file():
        raise InputError(path, "is a folder or a device, not a file", "choose another --out")
    if path.exists() and not overwrite:
        raise InputError(path, "exists already", "choose another --out or pass --overwrite")


def check_writable(path: str | Path) -> None:
    """Raise InputError where nothing can be made beside a file or folder to write: before long work."""
    path = Path(path).resolve()
    with _write_errors(path):  # permissions alone do not tell: try
        probe = _temporary(next(parent for parent in path.parents if parent.exists()) / path.name, ".probe")
        probe.mkdir()
        probe.rmdir()


def _holds_current(path: Path) -> bool:
    try:
        here = Path.cwd().resolve()
    except FileNotFoundError:  # somebody removed it
        return False
    return path == here or path in here.parents


def _take_place(part: Path, path: Path) -> None:
    if not path.exists():
        part.rename(path)
        return
    old = _temporary(path, ".old")
    path.rename(old)
    try:
        part.rename(path)
    except BaseException:
        old.rename(path)
        raise
    shutil.rmtree(old, ignore_errors=True)
