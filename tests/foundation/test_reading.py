"""Paths that are not readable files, and errors of the libraries that read files, give one clear error; JSON."""

import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import (
    check_folder,
    check_readable,
    json_text,
    json_values,
    open_file,
    parse_json,
    read_file,
    read_json_file,
    read_text,
    reading,
)


def test_reads_a_file_and_a_link_to_it(tmp_path):
    (tmp_path / "é\udcff").write_bytes(b"content")
    (tmp_path / "link").symlink_to(tmp_path / "é\udcff")
    assert read_file(tmp_path / "link") == b"content"
    assert check_readable(str(tmp_path / "link")) == tmp_path / "link"
    assert check_folder(str(tmp_path)) == tmp_path


@pytest.mark.parametrize("read", [check_readable, check_folder, read_file])
def test_paths_that_cannot_be_read(tmp_path, read):
    loop, fifo, closed = tmp_path / "loop", tmp_path / "fifo", tmp_path / "closed"
    loop.symlink_to(loop)
    os.mkfifo(fifo)
    closed.write_bytes(b"")
    cases = {
        tmp_path / "absent": "does not exist",
        closed / "x": "does not exist: a part of its path is a file",
        loop: "is a symbolic link that leads back to itself",
        tmp_path / ("n" * 256): "has a name that is too long",
        tmp_path / "a\0b": "contains a character that no file name has",
        tmp_path / "\ud800": "contains a character that no file name has",
        fifo: "is a device or a pipe, not" if read is not check_folder else "is a file, not a folder",
        Path("/dev/zero"): "is a device or a pipe, not" if read is not check_folder else "is a file, not a folder",
    }
    for path, message in cases.items():
        with pytest.raises(InputError, match=message) as caught:
            read(path)
        assert str(caught.value).isprintable()
    with pytest.raises(InputError, match=r"is a (folder, not a file|file, not a folder)"):
        read(tmp_path if read is not check_folder else closed)


def test_errors_of_the_system(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"1")

    def fail(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    with (
        pytest.raises(InputError, match=r"cannot be read: Input/output error \(check the disk"),
        open_file(tmp_path / "file"),
    ):
        raise OSError(errno.EIO, os.strerror(errno.EIO))
    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(InputError, match=r"cannot be read: permission denied \(change its permissions"):
        check_readable(tmp_path / "file")


@pytest.mark.parametrize("error", [KeyError("nodes"), MemoryError(), RecursionError("too deep"), OSError("bad block")])
def test_any_exception_of_a_library_is_one_line_with_the_file(tmp_path, error):
    file = tmp_path / "file.slp"
    file.write_bytes(b"1")
    message = r"file\.slp: is not a SLEAP project that can be read: .+ \(export it again\)"
    with pytest.raises(InputError, match=message), reading(file, "a SLEAP project", "export it again"):
        raise error
    with pytest.raises(InputError, match="does not exist"), reading(tmp_path / "absent", "a SLEAP project"):
        raise AssertionError("the body must not run")


def test_an_input_error_of_the_body_stays_as_it_is(tmp_path):
    (tmp_path / "file").write_bytes(b"1")
    with pytest.raises(InputError, match=r"^inner: problem"), reading(tmp_path / "file", "a file"):
        raise InputError("inner", "problem", "remedy")


def test_content_of_json(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": [1, null, "\xc3\xa9"]}')  # a byte order mark
    assert read_json_file(str(path)) == {"a": [1, None, "é"]}
    assert read_text(path, "a text").startswith("{")
    assert parse_json("3", "x") == 3


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b" \n", "is empty"),
        (b'{"a": 1', "line 1, column 8.*ends midway"),
        (b'{"a": \n x}', "line 2, column 2.*correct the file"),
        (b'"a\nb"', "line 1"),
        (b"\n\xff", "line 2 is not UTF-8"),
        (b"[" * 100_000, "recursion depth"),
        (b"1" * 5000, "digits"),
        (b'{"a": {"b": 1, "b": 2}}', 'holds the key "b" twice'),
    ],
)
def test_files_that_are_not_json(tmp_path, content, words):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_json_file(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_numpy_values_become_plain_and_nan_becomes_none():
    content = {
        "nan": math.nan,
        "rows": (1, [np.float32(0.5), -math.inf]),
        "array": np.array([[1.0, math.nan]]),
        3: np.int64(7),
        "flag": np.bool_(True),
        "none": None,
        "text": "a",
    }
    expected = {
        "nan": None,
        "rows": [1, [0.5, None]],
        "array": [[1.0, None]],
        "3": 7,
        "flag": True,
        "none": None,
        "text": "a",
    }
    assert json_values(content) == expected
    assert json.loads(json_text(content, indent=None)) == expected
    with pytest.raises(TypeError):
        json_text({"set": {1, 2}})
