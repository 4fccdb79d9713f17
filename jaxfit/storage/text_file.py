"""Text of a file: read whole, with a limit on its size, and only from regular files."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from jaxfit.errors import InputError

__all__ = ["read_bytes", "read_text"]


def read_text(path: str | Path, most_bytes: int, kind: str) -> str:
    """Return the text of a UTF-8 file, without a byte order mark.

    Args:
        path: the file.
        most_bytes: size of the largest file that is accepted.
        kind: the kind of file in messages, such as `a YAML file`.

    Raises:
        InputError: as `read_bytes`; or the content is not UTF-8.
    """
    content = read_bytes(path, most_bytes, kind)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        problem = f"line {line} is not UTF-8 text (byte {error.start})"
        raise InputError(path, problem, f"give {kind}, saved as UTF-8") from None


def read_bytes(path: str | Path, most_bytes: int, kind: str) -> bytes:
    """Return the content of a file.

    Args:
        path: the file.
        most_bytes: size of the largest file that is accepted.
        kind: the kind of file in messages, such as `a YAML file`.

    Raises:
        InputError: the file does not exist, is no regular file (a folder, a pipe, a device), is too large, or cannot
            be read.
    """
    try:
        # a pipe without a writer would block a plain open
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if stat.S_ISDIR(status.st_mode):
                raise IsADirectoryError
            if not stat.S_ISREG(status.st_mode):
                raise InputError(path, f"is a pipe or a device, not {kind}", "give a file")
            if status.st_size <= most_bytes:
                # one byte more shows that the file grows; files of the system have content, but no size
                content = file.read((status.st_size or most_bytes) + 1)
                if len(content) <= most_bytes:
                    return content
            problem = f"has {max(status.st_size, most_bytes + 1):,} bytes, more than {most_bytes:,}"
            raise InputError(path, problem, f"give {kind} of at most {most_bytes:,} bytes")
    except FileNotFoundError:
        raise InputError(path, "does not exist", "check the path") from None
    except IsADirectoryError:
        raise InputError(path, f"is a folder, not {kind}", "give the file inside it") from None
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise InputError(path, f"cannot be read: {reason}", "check the path and its permissions") from None
    except InputError:
        raise
    except ValueError:  # the path holds NUL, or characters that no file name can hold
        raise InputError(path, "is not the name of a file", "check the path") from None
