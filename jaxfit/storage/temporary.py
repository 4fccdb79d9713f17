"""Temporary files and folders next to a target; removal of the temporary files of killed processes.

A writer of `out` first creates `.out.<hex>.lock` in the same folder and holds a lock (flock) on this file as long as
`.out.<hex>.part` or `.out.<hex>.old` exists. The operating system frees the lock when the process ends, also after
SIGKILL. A file `.lock` without a lock therefore belongs to no living process. The next write into the folder removes
this file with its `.part` and `.old`. An `.old` without its target is the earlier folder of an interrupted replacement,
and is renamed back to its target.

On a shared disk, some network file systems keep locks to each computer. The lock file therefore names its computer, and
what another computer has left is removed only after `LEFTOVER_DAYS` without a change. Where the file system has no
locks, nothing is removed.
"""

from __future__ import annotations

import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from jaxfit.limits import LEFTOVER_DAYS

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

__all__ = ["NoLocksError", "Temporary", "is_open", "remove_leftovers", "temporary", "try_lock"]

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
    """Yield temporary names in the folder of a target; remove at the end what exists under these names.

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
        _own_parts.discard(names.part)
        _finish(stem, names)
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
