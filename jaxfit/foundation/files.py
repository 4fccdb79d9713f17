"""Atomic writing of files and folders, and temporary names beside them.

Temporary files and folders next to a target; removal of the temporary files of killed processes. A writer of `out`
first creates `.out.<hex>.lock` in the same folder and holds a lock (flock) on this file as long as `.out.<hex>.part` or
`.out.<hex>.old` exists. The operating system frees the lock when the process ends, also after SIGKILL. A file `.lock`
without a lock therefore belongs to no living process. The next write into the folder removes this file with its `.part`
and `.old`. An `.old` without its target is the earlier folder of an interrupted replacement, and is renamed back to its
target.

On a shared disk, some network file systems keep locks to each computer. The lock file therefore names its computer, and
what another computer has left is removed only after `LEFTOVER_DAYS` without a change. Where the file system has no
locks, nothing is removed.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import LEFTOVER_DAYS, NAME_BYTES

# Errors of the operating system for a write, and the action that the user can take.
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EDQUOT: "free some of your quota or choose another place",
    errno.EFBIG: "choose a file system that supports files of this size",
    errno.EROFS: "choose a place with write access",
    errno.EACCES: "change its permissions or choose a place with write access",
    errno.EPERM: "change its permissions or choose a place with write access",
    errno.EBUSY: "it is a mount point or in use: choose a folder inside it",
    errno.EIO: "check the disk or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "choose another place",
    errno.ENOTDIR: "a part of its path is a file: choose another place",
    errno.EEXIST: "a part of its path is a file: choose another place",
    errno.ELOOP: "a symbolic link of its path leads back to itself: choose another place",
    errno.EINVAL: "choose another name",
    errno.EILSEQ: "choose another name",
    errno.ENXIO: "choose another place",
    errno.ESTALE: "check the network disk or choose another place",
    errno.ENOTEMPTY: "another program has written there in the meantime: choose another place",
}


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the body to an InputError that names ``path``."""
    try:
        yield
    except OSError as error:
        if error.errno not in _REMEDIES:
            raise
        problem = f"cannot be written: {os.strerror(error.errno)}"
        raise InputError(path, problem, _REMEDIES[error.errno]) from error


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
            names = [os.fsencode(name) for name in path.parts]
        except UnicodeEncodeError:
            names = [b"\0"]
        if any(b"\0" in name for name in names):
            raise InputError(path, "contains a character that no file name has", "choose another name")
        if any(len(name) > NAME_BYTES for name in names):
            raise OSError(errno.ENAMETOOLONG, "")
        with suppress(FileNotFoundError):
            path.stat()  # resolve() has other errors for cyclic links
        return path.resolve()


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
    with write_errors(named), created_parents(path), temporary(path) as names:
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
    with write_errors(named), created_parents(path), temporary(path) as names:
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
        with temporary(existing / target.name) as names:
            names.part.mkdir()


def _contains_current(path: Path) -> bool:
    try:
        current = Path.cwd().resolve()
    except FileNotFoundError:  # the current folder was removed
        return False
    return path == current or path in current.parents


def _replace_folder(names: Temporary, path: Path) -> None:
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


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


_LOCK = re.compile(r"\..*\.[0-9a-f]{8}\.lock", re.DOTALL)
_MARK = b"jaxfit"
_own_parts: set[Path] = set()
"""Temporary folders of this process; files in them need no lock of their own."""


class Temporary(NamedTuple):
    """The temporary names for one target."""

    part: Path
    """The new file or folder, until it is complete."""
    old: Path
    """The earlier folder, while the new folder takes its name."""


@contextmanager
def temporary(target: Path) -> Iterator[Temporary]:
    """Yield temporary names in the folder of a target, and remove the files that still have these names at the end.

    Removes first what killed processes have left in the folder.

    Args:
        target: the file or folder to write, an absolute path in an existing folder.

    Raises:
        OSError: the folder does not allow new files.
    """
    if not _own_parts.isdisjoint(target.parents):
        names = _names(_stem(target))
        try:
            yield names
        finally:
            _remove(names.part)
        return
    remove_leftovers(target.parent)
    stem, descriptor = _locked(target)
    names = _names(stem)
    _own_parts.add(names.part)
    try:
        yield names
    finally:
        try:
            _finish(stem, names)
        except KeyboardInterrupt:  # in the middle of the removal
            _finish(stem, names)
            raise
        finally:
            _own_parts.discard(names.part)
            if descriptor is not None:
                os.close(descriptor)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders in a folder that no living process owns."""
    with suppress(OSError, ValueError):  # the folder may not exist or not be readable, and no folder has a NUL
        for name in os.listdir(folder):  # noqa: PTH208 - a list, because the loop removes names
            if _LOCK.fullmatch(name):
                with suppress(OSError):  # the lock of a living process or of another user
                    _remove_group(folder / name)


def _names(stem: Path) -> Temporary:
    return Temporary(stem.with_name(f"{stem.name}.part"), stem.with_name(f"{stem.name}.old"))


def _stem(target: Path) -> Path:
    # in the same folder, so that a rename stays within one file system; 255 bytes is the longest name
    name = os.fsencode(target.name)[:200].decode(errors="ignore")
    return target.with_name(f".{name}.{secrets.token_hex(4)}")


def _lock_of(stem: Path) -> Path:
    return stem.with_name(f"{stem.name}.lock")


def _locked(target: Path) -> tuple[Path, int | None]:
    """Create and lock a lock file for a target; the descriptor is None where the file system has no locks."""
    while True:
        stem = _stem(target)
        lock = _lock_of(stem)
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            if not try_lock(descriptor) or not is_open(lock, descriptor):
                os.close(descriptor)  # another process has just taken the new file for a leftover
                continue
            os.write(descriptor, b"\n".join((_MARK, os.fsencode(platform.node()), os.fsencode(target.name))))
        except OSError as error:
            os.close(descriptor)
            lock.unlink(missing_ok=True)
            if isinstance(error, NoLocksError):
                return stem, None
            raise
        return stem, descriptor


class NoLocksError(OSError):
    """The file system or the operating system has no locks."""


def try_lock(descriptor: int) -> bool:
    """Lock an open file; False if another process has locked the file."""
    if fcntl is None:
        raise NoLocksError
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise NoLocksError from error
    return True


def is_open(path: Path, descriptor: int) -> bool:
    """Return whether a path still names the open file."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _finish(stem: Path, names: Temporary) -> None:
    """Remove the temporary names; the lock file stays where they could not be removed."""
    _remove(names.part)
    if not any(map(os.path.lexists, names)):
        _lock_of(stem).unlink(missing_ok=True)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _remove_group(lock: Path) -> None:
    """Remove a lock file and its temporary names if no living process owns them."""
    descriptor = os.open(lock, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        if not try_lock(descriptor) or not is_open(lock, descriptor):
            return
        content = os.read(descriptor, 4096).split(b"\n", 2)
        stem = lock.with_name(lock.name.removesuffix(".lock"))
        names = _names(stem)
        if content == [b""] and not any(map(os.path.lexists, names)):  # killed before the content was written
            lock.unlink()
        if len(content) != 3 or content[0] != _MARK:
            return
        if content[1] != os.fsencode(platform.node()) and _age_days(lock, *names) < LEFTOVER_DAYS:
            return
        target = lock.with_name(Path(os.fsdecode(content[2])).name)
        if os.path.lexists(names.old):
            if os.path.lexists(target):
                _remove(names.old)
            else:
                names.old.rename(target)
        _finish(stem, names)
    finally:
        os.close(descriptor)


def _age_days(*paths: Path) -> float:
    changed = max(path.lstat().st_mtime for path in paths if os.path.lexists(path))
    return (time.time() - changed) / 86400
