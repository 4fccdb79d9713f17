"""The boundary around foreign files: every failure of a reader becomes a one-line error. JSON text."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxfit.foundation.errors import InputError

_CHECK_PATH = "check the path"
# Errors of the operating system for a read: the problem, and the action that the user can take.
_PROBLEMS = {
    errno.ENOENT: ("does not exist", ""),  # the remedy is an argument
    errno.ENOTDIR: ("does not exist: a part of its path is a file", "check the path"),
    errno.ELOOP: ("is a symbolic link that leads back to itself", "check the links of its path"),
    errno.ENAMETOOLONG: ("has a name that is too long for this system", "check the path"),
    errno.EACCES: ("cannot be read: permission denied", "change its permissions"),
    errno.EPERM: ("cannot be read: permission denied", "change its permissions"),
}


def check_readable(path: str | Path, kind: str = "a file", absent: str = _CHECK_PATH) -> Path:
    """Check that a path is a regular file that can be read; call this function before a library opens the path.

    Args:
        path: the file.
        kind: the expected kind of file with its article, such as ``an .npz file``, for the message.
        absent: the remedy where the path does not exist, such as the command that writes the file.

    Returns:
        The path.

    Raises:
        InputError: the path does not exist, is not a regular file (a folder, a device, a pipe), is a cyclic symbolic
            link, has a name that is too long or that no file can have, or cannot be read.
    """
    with open_file(path, kind, absent):
        return Path(path)


@contextmanager
def reading(path: str | Path, kind: str, remedy: str = "", absent: str = _CHECK_PATH) -> Iterator[Path]:
    """Convert every exception of a library that reads a file in the body to one InputError, as a context manager.

    Call a library plainly in the body. Check shapes, finite numbers and ranges after the body, in the container that
    receives the data.

    Args:
        path: the file.
        kind: the expected kind of file with its article, such as ``a SLEAP project``.
        remedy: the remedy of the message; the default is to write the file again.
        absent: the remedy where the path does not exist.

    Yields:
        The path.

    Raises:
        InputError: the path is not a readable file (`check_readable`), or the body raises any exception; an InputError
            of the body stays as it is.
    """
    check_readable(path, kind, absent)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # libraries warn about damage that the check of the content reports
            yield Path(path)
    except InputError:
        raise
    except Exception as error:  # libraries raise any class for damaged content, MemoryError and RecursionError too
        text = str(error).strip()
        reason = f"{type(error).__name__}: {text}" if isinstance(error, KeyError) or not text else text
        raise InputError(path, f"is not {kind} that can be read: {reason}", remedy or "write the file again") from error


def check_folder(path: str | Path, kind: str = "a folder", absent: str = _CHECK_PATH) -> Path:
    """Check that a path is a folder; arguments, result and errors as `check_readable`."""
    path = Path(path)
    with _read_errors(path, absent):
        if not stat.S_ISDIR(path.stat().st_mode):
            raise InputError(path, f"is a file, not {kind}", "check the path")
    return path


@contextmanager
def open_file(path: str | Path, kind: str = "a file", absent: str = _CHECK_PATH) -> Iterator[BinaryIO]:
    """Open a regular file for reading bytes, as a context manager; arguments and errors as `check_readable`.

    An error of the operating system in the body, such as a damaged disk, is an InputError too.
    """
    path = Path(path)
    with _read_errors(path, absent):
        mode = path.stat().st_mode  # before the open, because opening a pipe waits and devices may react
        if stat.S_ISDIR(mode):
            raise InputError(path, f"is a folder, not {kind}", "check the path")
        if not stat.S_ISREG(mode):
            raise InputError(path, f"is a device or a pipe, not {kind}", "check the path")
        with path.open("rb") as file:
            yield file


def read_file(path: str | Path, kind: str = "a file") -> bytes:
    """Return the bytes of a regular file.

    Raises:
        InputError: as `check_readable`.
    """
    with open_file(path, kind) as file:
        return file.read()


def read_text(path: str | Path, kind: str) -> str:
    """Return the text of a UTF-8 file, without a byte order mark.

    Raises:
        InputError: as `read_file`; or the content is not UTF-8.
    """
    content = read_file(path, kind)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        problem = f"line {line} is not UTF-8 text (byte {error.start})"
        raise InputError(path, problem, f"give {kind}, saved as UTF-8") from None


@contextmanager
def _read_errors(path: Path, absent: str) -> Iterator[None]:
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
        raise InputError(path, problem, remedy or absent) from error


def read_json_file(path: str | Path, kind: str = "a JSON file") -> Any:
    """Return the content of a JSON file as dicts, lists and plain values.

    Raises:
        InputError: as `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, kind), path)


def parse_json(text: str, source: object) -> Any:
    """Return the content of a JSON text as dicts, lists and plain values.

    The numbers NaN, Infinity and -Infinity are accepted, although JSON does not define them.

    Args:
        text: the JSON text.
        source: the file, for messages.

    Raises:
        InputError: the text is empty or is not JSON (the message names line and column), has more levels or digits
            than Python reads, or has an object that holds a key twice.
    """
    if not text.strip():
        raise InputError(source, "is empty", "write it again")

    def content_of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
            raise InputError(source, f'holds the key "{twice}" twice in one object', "remove one of the two")
        return content

    try:
        return json.loads(text, object_pairs_hook=content_of)
    except json.JSONDecodeError as error:
        # a truncated file has its error at its end, or at the string or list that is not closed
        truncated = text.lstrip().startswith(("{", "[")) and not text.rstrip().endswith(("}", "]"))
        remedy = "the file ends midway: copy or write it again" if truncated else "correct the file or write it again"
        problem = f"is not valid JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        raise InputError(source, problem, remedy) from None
    except InputError:
        raise
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(source, f"is not JSON that can be read: {error}", "write it again") from None


def json_text(content: Any, indent: int | None = 2) -> str:
    """Return the JSON text of `json_values` of the content.

    Args:
        content: mappings, sequences, arrays and scalars.
        indent: spaces of each level; None writes one line.

    Raises:
        TypeError: the content holds a value that JSON cannot represent.
    """
    return json.dumps(json_values(content), indent=indent, allow_nan=False)


def json_values(content: Any) -> Any:
    """Return the content in the types of JSON.

    Arrays and tuples become lists, NumPy scalars become Python scalars, keys become text, and NaN and infinite
    numbers become None, since JSON has no such numbers.
    """
    if isinstance(content, np.ndarray | np.generic) or hasattr(content, "__array__"):
        content = np.asarray(content).tolist()
    if isinstance(content, Mapping):
        return {str(key): json_values(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [json_values(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
