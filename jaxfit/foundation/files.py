"""Atomic writing of files and folders.

A writer of `out` first creates `.out.<computer>.<hex>.lock` in the same folder and holds a lock on this file as long as
`.part` or `.old` of the same name exists. The operating system frees the lock when the process ends, also after
SIGKILL. A lock file without a lock therefore belongs to no living process, and the next write into the folder
removes this file with its `.part` and `.old`. An `.old` without its target is the earlier folder of an interrupted
replacement, and is renamed back to its target. The name of the computer is there because some network file systems
keep locks to each computer.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from filelock import FileLock

from jaxfit.foundation.errors import InputError

# Errors of the operating system for a write, and the action that the user can take.
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EDQUOT: "free some of your quota or choose another place",
    errno.EROFS: "choose a place with write access",
    errno.EACCES: "change its permissions or choose a place with write access",
    errno.EPERM: "change its permissions or choose a place with write access",
    errno.EBUSY: "it is a mount point or in use: choose a folder inside it",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOTDIR: "a part of its path is a file: choose another place",
    errno.EEXIST: "a part of its path is a file: choose another place",
    errno.ELOOP: "a symbolic link of its path leads back to itself: choose another place",
}


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the body to an InputError that names ``path``."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        problem = f"cannot be written: {os.strerror(error.errno)}"
        raise InputError(path, problem, _REMEDIES.get(error.errno, "choose another place")) from error


@contextmanager
def _own_name(part: Path, path: Path) -> Iterator[None]:
    """Replace a temporary name in the errors of the body by the name that the user gave."""
    try:
        yield
    except InputError as error:
        if str(part) not in error.source:
            raise
        source = error.source.replace(str(part), str(path))
        raise InputError(source, error.problem.replace(str(part), str(path)), error.remedy) from error


def resolved(path: Path) -> Path:
    """Return the absolute path without symbolic links; a path that cannot exist is an InputError."""
    with write_errors(path):
        try:
            with suppress(FileNotFoundError):
                path.stat()  # resolve() has other errors for cyclic links
            return path.resolve()
        except ValueError:
            raise InputError(path, "contains a character that no file name has", "choose another name") from None


@contextmanager
def created_parents(path: Path) -> Iterator[None]:
    """Create the missing folders above ``path``; if the body fails, remove these folders again."""
    missing = [parent for parent in path.parents if not parent.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for parent in missing:
            try:
                parent.rmdir()
            except OSError:  # the folder was not created, or another program uses the folder
                break
        raise


def _sync(path: Path) -> None:
    """Wait until ``path`` (a file, or the list of names of a folder) is on the disk."""
    if path.is_dir():
        # some systems cannot open folders, and some file systems cannot sync folders
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
    """Write one file atomically, as ``new_file`` does.

    Args:
        path: the file; an existing file is replaced.
        content: the bytes, or a function that writes the bytes to an open binary file.

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
    """Write a file atomically, as a context manager.

    ``with new_file("out.mp4") as part:`` yields a temporary path in the same folder, and the body writes this file.
    At the end of the body, the file is synced to the disk and then renamed to ``path``. A reader therefore never sees
    an incomplete file, and an existing file of that name survives a failure. Missing folders above are created.

    Args:
        path: the file; an existing file is replaced.

    Raises:
        InputError: ``path`` is a folder or a device, or the system rejects the write (disk full, quota,
            read-only, permissions).
    """
    named = Path(path)
    path = resolved(named)  # a symbolic link stays a link, and its target is replaced
    if path.exists() and not path.is_file():
        raise InputError(named, "is a folder or a device, not a file", "choose another name")
    with write_errors(named), created_parents(path), _temporary(path) as names:
        with _own_name(names.part, named):
            yield names.part
        _sync(names.part)
        names.part.replace(path)
        _sync(path.parent)


@contextmanager
def new_folder(path: str | Path, overwrite: bool = False, marker: str | None = None) -> Iterator[Path]:
    """Write a folder atomically, as a context manager.

    ``with new_folder("out") as folder:`` yields a temporary folder beside ``path``. At the end of the body, the
    temporary folder is renamed to ``path``; if the body fails, the temporary folder is removed. An existing folder is
    replaced only after the new folder is complete. (A power failure between the two renames leaves the existing folder
    under ``.out.<hex>.old``; the next write into the same folder renames this folder back, see
    `jaxfit.foundation.files`.)

    Args:
        path: the folder; missing folders above are created.
        overwrite: replace a folder that is not empty.
        marker: name of a file that every folder of this kind contains. A folder without this file is not replaced,
            even with ``overwrite``, because the folder may be a home directory.

    Raises:
        InputError: the folder is not empty, is not a folder, lacks the ``marker``, is the current folder or a folder
            above it, or the system rejects the write (disk full, quota, read-only, permissions).
    """
    named = Path(path)
    check_replaceable(named, overwrite, marker)
    path = resolved(named)
    with write_errors(named), created_parents(path), _temporary(path) as names:
        names.part.mkdir()
        with _own_name(names.part, named):
            yield names.part
        for entry in [*names.part.rglob("*"), names.part]:
            _sync(entry)
        check_replaceable(named, overwrite, marker)  # again, because the body may have taken hours
        _replace_folder(names, path)
        _sync(path.parent)


def check_replaceable(path: str | Path, overwrite: bool, marker: str | None = None) -> None:
    """Raise the InputError that `new_folder` would raise for ``path``; call this function before long work."""
    named, path = Path(path), resolved(Path(path))
    if _contains_current(path):  # a replacement would leave the shell in a removed folder
        raise InputError(named, "is the folder you are in, or one above it", "name a folder inside it")
    check_writable(named)
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(named, "is a file, not a folder", "choose another --out")
    remove_leftovers(path)
    with write_errors(named):
        if not any(path.iterdir()):
            return
    if not overwrite:
        raise InputError(named, "holds results already", "choose another --out or pass --overwrite")
    if marker is not None and not (path / marker).is_file():
        problem = f"holds files, but no {marker}, so it is not a folder of results and is not replaced"
        raise InputError(named, problem, "choose another --out")


def check_new_file(path: Path, overwrite: bool) -> None:
    """Raise InputError if ``path`` exists and a new file must not replace it."""
    target = resolved(path)
    if target.exists() and not target.is_file():
        raise InputError(path, "is a folder or a device, not a file", "choose another --out")
    if target.exists() and not overwrite:
        raise InputError(path, "exists already", "choose another --out or pass --overwrite")


def check_writable(path: str | Path) -> None:
    """Raise InputError if the folder of ``path`` is not writable; call this function before long work."""
    path = Path(path)
    target = resolved(path)
    with write_errors(path):  # permissions alone are not sufficient information, so try a write
        existing = next(parent for parent in target.parents if parent.exists())
        with _temporary(existing / target.name) as names:
            names.part.mkdir()


def _contains_current(path: Path) -> bool:
    try:
        current = Path.cwd().resolve()
    except FileNotFoundError:  # the current folder was removed
        return False
    return path == current or path in current.parents


def _replace_folder(names: _Names, path: Path) -> None:
    """Rename the new folder to `path`; if this fails, restore the existing folder."""
    if not path.exists():
        names.part.rename(path)
        return
    path.rename(names.old)
    try:
        names.part.rename(path)
    except BaseException:
        names.old.rename(path)
        raise
    shutil.rmtree(names.old, ignore_errors=True)


_COMPUTER = re.sub(r"[^A-Za-z0-9-]", "-", platform.node())[:20]
_LOCK = re.compile(rf"(\.(.*)\.{_COMPUTER}\.[0-9a-f]{{8}})\.lock", re.DOTALL)
_own_parts: set[Path] = set()
"""Temporary folders of this process; files in them need no lock of their own."""


class _Names(NamedTuple):
    """The temporary names for one target."""

    part: Path
    """The new file or folder, until it is complete."""
    old: Path
    """The earlier folder, while the new folder takes its name."""
    lock: Path

    @classmethod
    def beside(cls, folder: Path, stem: str) -> _Names:
        """Return the names with a stem in the folder of the target, so that a rename stays in one file system."""
        return cls(folder / f"{stem}.part", folder / f"{stem}.old", folder / f"{stem}.lock")


@contextmanager
def _temporary(target: Path) -> Iterator[_Names]:
    """Yield temporary names in the folder of a target, and remove the files that still have these names at the end.

    Removes first what killed processes have left in the folder.

    Args:
        target: the file or folder to write, an absolute path in an existing folder.

    Raises:
        OSError: the folder does not allow new files.
    """
    name = os.fsencode(target.name)[:200].decode(errors="ignore")  # 255 bytes is the longest name
    names = _Names.beside(target.parent, f".{name}.{_COMPUTER}.{secrets.token_hex(4)}")
    inside = not _own_parts.isdisjoint(target.parents)
    if not inside:
        remove_leftovers(target.parent)
    with nullcontext() if inside else FileLock(names.lock, blocking=False):
        _own_parts.add(names.part)
        try:
            yield names
        finally:
            _own_parts.discard(names.part)
            _remove(names.part)
            if not os.path.lexists(names.old):
                with suppress(OSError):  # Windows removes the lock file at the end of the lock
                    names.lock.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders in a folder that no living process owns."""
    with suppress(OSError, ValueError):  # the folder may not exist or not be readable, and no folder has a NUL
        for lock in list(folder.iterdir()):
            if match := _LOCK.fullmatch(lock.name):
                with suppress(OSError), FileLock(lock, blocking=False):  # a living process has locked the file
                    names, target = _Names.beside(folder, match[1]), folder / match[2]
                    if os.path.lexists(names.old) and not os.path.lexists(target):
                        names.old.rename(target)
                    _remove(names.part)
                    _remove(names.old)
                    lock.unlink()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
