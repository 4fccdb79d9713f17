"""Unfinished work beside a result: one process at a time, numbered parts.

Parts of a long computation: numbered `.npz` files in one folder, with a record of what they depend on. Every file
appears whole or not at all. The record `record.json` is written with the first file. A computation that depends on
something else is refused as long as the folder holds files, or begins again if the user cannot undo the difference.

The folder of the result `out` is `out.unfinished`. The process that works in the folder holds a lock on the file
`lock`. The operating system frees the lock when the process ends, also after SIGKILL.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from jaxfit.foundation.array_files import load_npz
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import created_parents, remove_leftovers, resolved, write_errors, write_whole
from jaxfit.foundation.reading import check_readable, read_json_file

_logger = logging.getLogger(__name__)

RECORD = "record.json"
"""Name of the file that holds the record."""
_SHOWN = 3
"""Number of differences that a message names."""


class Parts:
    """The parts of one computation. One process at a time may use the folder (`jaxfit.foundation.unfinished`).

    Args:
        folder: the folder, which may be absent.
        record: name → JSON value that the content of the parts depends on; values may be mappings.
        renewed: beginnings of the paths of values, such as `networks`. If only these values differ, the parts are
            removed, with a warning.

    Raises:
        InputError: the folder holds parts with another record; the message names the differences.
    """

    numbers: list[int]
    """Numbers of the stored parts, in increasing order."""
    size_bytes: int
    """Size of the stored parts."""

    def __init__(self, folder: Path, record: Mapping[str, Any], renewed: tuple[str, ...] = ()):
        self._folder, self._record = folder, json.loads(json.dumps(record))
        remove_leftovers(folder)
        self.numbers = sorted(int(file.stem) for file in folder.glob("*.npz") if file.stem.isdigit())
        self.size_bytes = sum(self._path(number).stat().st_size for number in self.numbers)
        if self.numbers:
            self._check_record(renewed)

    def add(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Store the next part.

        Raises:
            InputError: the disk is full, or the folder cannot be written.
        """
        if not self.numbers:
            write_whole(self._folder / RECORD, json.dumps(self._record, indent=1).encode())
        number = self.numbers[-1] + 1 if self.numbers else 0
        write_whole(self._path(number), lambda file: np.savez_compressed(file, **dict[str, Any](arrays)))
        self.numbers.append(number)
        self.size_bytes += self._path(number).stat().st_size

    def load(self, number: int, layout: Mapping[str, str]) -> dict[str, np.ndarray]:
        """Return the arrays of a part.

        Args:
            number: number of the part.
            layout: name → shape, as the argument `required` of `jaxfit.foundation.array_files.load_npz`.

        Raises:
            InputError: the file is damaged.
        """
        path = self._path(number)
        try:
            return load_npz(path, layout)
        except InputError as error:
            raise self.damaged(number, error.problem) from error

    def damaged(self, number: int, problem: str) -> InputError:
        """Return the error about a part that cannot be used."""
        return InputError(self._path(number), problem, "remove this file; the same command computes its content again")

    def keep(self, count: int) -> None:
        """Remove all parts except the first `count` parts."""
        for number in self.numbers[count:]:
            self.size_bytes -= self._path(number).stat().st_size
            self._path(number).unlink()
        del self.numbers[count:]

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"

    def _check_record(self, renewed: tuple[str, ...]) -> None:
        changed = list(differences(read_record(self._folder), self._record))
        if not changed:
            return
        more = f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        problem = f"was begun with another {', '.join(changed[:_SHOWN])}{more}"
        if all(name.startswith(renewed) for name in changed):
            _logger.warning("%s: %s, so the work begins again", self._folder, problem)
            self.keep(0)
            return
        remedy = "repeat the earlier command to continue, or remove this folder to begin again"
        raise InputError(self._folder, problem, remedy)


def read_record(folder: Path) -> Any:
    """Return the record of the parts in a folder.

    Raises:
        InputError: the file is absent, cannot be read, or is no JSON.
    """
    return read_json_file(check_readable(folder / RECORD, "a record", "remove this folder to begin again"))


def differences(stored: Any, wanted: Any, name: str = "") -> Iterator[str]:
    """Yield the paths, such as `track.frames.stop`, of the values that differ."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        for key in dict.fromkeys([*wanted, *stored]):
            yield from differences(stored.get(key), wanted.get(key), f"{name}.{key}" if name else key)
    elif stored != wanted:
        yield name or "record"


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
            stack.enter_context(_locked_folder(named, path))
        try:
            yield named
        except BaseException:
            if not any(path.rglob("*.npz")):
                _remove(path)
            raise
        _remove(path)


def _locked_folder(named: Path, path: Path) -> FileLock:
    """Create the folder if it is absent, and return its lock, which this process now holds."""
    file = path / _LOCK
    path.mkdir(exist_ok=True)
    if any(path.iterdir()) and not file.is_file():
        problem = "holds files, but no lock, so it is not a folder of unfinished work"
        raise InputError(named, problem, "choose another --out, or remove this folder")
    lock = FileLock(file, blocking=False)
    try:
        lock.acquire()
    except Timeout:
        problem, remedy = "another jaxfit works on this result", "wait until it ends, or choose another --out"
        raise InputError(named, problem, remedy) from None
    return lock


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
