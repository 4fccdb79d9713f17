"""JSON and text files: content, and one error for files that are not JSON, too large, too deep or no files."""

import os

import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import JSON_LEVELS
from jaxfit.foundation.reading import parse_json, read_json_file, read_text

DEEPEST = "[" * JSON_LEVELS + "]" * JSON_LEVELS


def test_content(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": [1, null, "\xc3\xa9"]}')  # a byte order mark
    assert read_json_file(path, 100) == {"a": [1, None, "é"]}
    assert read_json_file(str(path), path.stat().st_size) == {"a": [1, None, "é"]}
    assert parse_json("3", "x") == 3
    assert parse_json(DEEPEST, "x")[0][0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b" \n", "is empty"),
        (b'{"a": 1', "line 1, column 8.*ends midway"),
        (b'{"a": \n x}', "line 2, column 2.*correct the file"),
        (b'"a\nb"', "line 1"),
        (b"\n\xff", "line 2 is not UTF-8"),
        (b"[" + DEEPEST.encode() + b"]", "more than 100 levels"),
        (b"[" * 100_000, "more than 100 levels"),
        (b"1" * 5000, "too many digits"),
        (b'"' + b"x" * 10_000 + b'"', "10,002 bytes, more than 10,000"),
    ],
)
def test_files_that_are_not_json(tmp_path, content, words):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_json_file(path, 10_000 if words[:1] == "1" else 10**6)
    assert str(caught.value).startswith(f"{path}: ")


def test_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    cases = {
        "absent": "does not exist",
        "": "is a folder, not a text",
        "pipe": "device or a pipe",
        "/dev/zero": "device or a pipe",
        "loop": "is a symbolic link that leads back to itself",
        "x" * 300: "has a name that is too long for this system",
        "a\0b": "contains a character that no file name has",
        "a\ud800": "contains a character that no file name has",
    }
    for name, words in cases.items():
        with pytest.raises(InputError, match=words):
            read_text(tmp_path / name, 10, "a text")
