"""Every path that is not a readable file gives one clear error."""

import errno
import os
from pathlib import Path

import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import check_folder, check_readable, open_file, read_file, reading


def test_reads_a_file_and_a_link_to_it(tmp_path):
    (tmp_path / "é\udcff").write_bytes(b"content")
    (tmp_path / "link").symlink_to(tmp_path / "é\udcff")
    assert read_file(tmp_path / "link", 7) == b"content"
    assert check_readable(str(tmp_path / "link")) == tmp_path / "link"
    assert check_folder(str(tmp_path)) == tmp_path
    with pytest.raises(InputError, match="has 7 bytes, more than 6"):
        read_file(tmp_path / "link", 6)


def test_files_of_the_system_have_size_0(tmp_path):
    if Path("/proc/self/maps").exists():
        with pytest.raises(InputError, match="bytes, more than 10"):
            read_file("/proc/self/maps", 10)


@pytest.mark.parametrize("read", [check_readable, check_folder, lambda path: read_file(path, 10)])
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
        tmp_path / "/".join(["deep" * 50] * 30): "has a name that is too long",
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
    monkeypatch.setattr(os, "open", fail)
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
