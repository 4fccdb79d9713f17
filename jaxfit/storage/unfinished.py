"""The folder of unfinished work beside a result: for one process at a time, kept until the result is complete.

The folder of the result `out` is `out.unfinished`. The process that works in the folder holds a lock (flock) on the
file `lock`. The operating system frees the lock when the process ends, also after SIGKILL, so no lock of a dead process
remains. Where the file system has no locks, and on Windows, nothing prevents a second process.
"""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from jaxfit.errors import InputError
from jaxfit.storage.files import created_parents, resolved, write_errors
from jaxfit.storage.temporary import NoLocksError, is_open, try_lock

__all__ = ["unfinished_folder", "unfinished_work"]

_LOCK = "lock"


def unfinished_folder(result: Path) -> Path:
    """Return the folder of the unfinished work for the result in a folder."""
    return result.with_name(f"{result.name}.unfinished")


@contextmanager
def unfinished_work(result: Path) -> Iterator[Path]:
    """Create or continue the folder of unfinished work for a result, as a context manager, and lock the folder.

    At the end of the body, the folder is removed. If the body fails and the folder holds parts (`.npz` files), the
    folder is kept.

    Args:
        result: the folder of the result.

    Raises:
        InputError: another process works in the folder, the folder holds other files, or cannot be written.
    """
    named = unfinished_folder(result)
    with ExitStack() as stack:
        with write_errors(named):
            path = resolved(named)
            stack.enter_context(created_parents(path))
            descriptor = _lock_folder(named, path)
        stack.callback(os.close, descriptor)
        try:
            yield named
        except BaseException:
            if not any(path.rglob("*.npz")):
                _remove(path)
            raise
        _remove(path)


def _lock_folder(named: Path, path: Path) -> int:
    """Create the folder if it is absent, lock its lock file and return the open file."""
    lock = path / _LOCK
    while True:
        path.mkdir(exist_ok=True)
        if any(path.iterdir()) and not lock.is_file():
            raise InputError(named, "holds files of another program", "choose another --out")
        try:
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another process has just removed the folder
            continue
        try:
            is_locked = try_lock(descriptor)
        except NoLocksError:
            return descriptor
        if not is_locked:
            owner = os.read(descriptor, 200).decode(errors="replace")
            os.close(descriptor)
            problem = f"another jaxfit works on this result{f' ({owner})' if owner else ''}"
            raise InputError(named, problem, "wait until it ends, or choose another --out")
        if is_open(lock, descriptor):
            with suppress(OSError):  # a full disk: the name of the owner is for messages only
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {platform.node()}".encode())
            return descriptor
        os.close(descriptor)


def _remove(path: Path) -> None:
    """Remove the folder; the lock file last, so that no other process begins in a folder that is being removed."""
    with suppress(OSError):
        for entry in path.iterdir():
            if entry.name == _LOCK:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()
        (path / _LOCK).unlink()
        path.rmdir()
