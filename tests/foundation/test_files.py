"""Files and folders are written atomically."""

import errno
import os
from pathlib import Path

import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_new_file, check_replaceable, check_writable, new_folder, write_whole


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def fill(path, content, **options):
    with new_folder(path, **options) as folder:
        content(folder)


def fail_with(number):
    def fail(*_):
        raise OSError(number, os.strerror(number))

    return fail


def test_writes_a_file_and_the_folders_above(tmp_path):
    path = tmp_path / "a" / "b" / "file.bin"
    write_whole(path, b"one")
    assert path.read_bytes() == b"one"
    write_whole(str(path), lambda file: file.write(b"two"))
    assert path.read_bytes() == b"two"
    assert names(path.parent) == ["file.bin"]


def test_writing_through_a_symbolic_link_keeps_the_link(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_whole(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_a_folder_or_device_is_not_replaced_by_a_file(tmp_path):
    for path in (tmp_path, Path("/dev/null")):
        with pytest.raises(InputError, match="is a folder or a device"):
            write_whole(path, b"")
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_rejected_write_changes_nothing(tmp_path, monkeypatch, number):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", fail_with(number))
    with pytest.raises(InputError, match=f"file: cannot be written: {os.strerror(number)} \\(") as caught:
        write_whole(path, b"new")
    assert str(caught.value).startswith(str(path))
    with pytest.raises(InputError):
        write_whole(tmp_path / "deep" / "down" / "file", b"new")
    assert names(tmp_path) == ["file"]
    assert path.read_bytes() == b"old"


def test_other_errors_are_not_converted_and_leave_no_files(tmp_path):
    def content(file):
        file.write(b"half")
        raise KeyError("a mistake in the program")

    with pytest.raises(KeyError):
        write_whole(tmp_path / "file", content)

    def interrupted(folder):
        (folder / "half").write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path / "a" / "out", interrupted)
    assert names(tmp_path) == []


def test_a_folder_appears_after_the_body(tmp_path):
    out = tmp_path / "results" / "cliff"
    with new_folder(out) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "file").write_bytes(b"1")
        assert not out.exists()
    assert (out / "sub" / "file").read_bytes() == b"1"
    assert names(out.parent) == ["cliff"]


def test_results_are_overwritten_only_on_request(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with new_folder(out) as folder:  # an empty folder may be replaced
        (folder / "poses.npz").write_bytes(b"1")
    with pytest.raises(InputError, match=r"out: holds results already \(choose another --out or pass --overwrite\)"):
        new_folder(out).__enter__()
    with new_folder(out, overwrite=True, marker="poses.npz") as folder:
        (folder / "new").write_bytes(b"2")
        assert names(out) == ["poses.npz"]  # the old folder remains until the new folder is complete
    assert names(out) == ["new"]
    with pytest.raises(InputError, match=r"holds files, but no poses\.npz"):
        new_folder(out, overwrite=True, marker="poses.npz").__enter__()
    assert names(tmp_path) == ["out"]


def test_results_that_another_program_writes_meanwhile_are_kept(tmp_path):
    out = tmp_path / "out"

    def write_second(folder):
        (folder / "file").write_bytes(b"second")
        out.mkdir()
        (out / "file").write_bytes(b"first")

    with pytest.raises(InputError, match="holds results already"):
        fill(out, write_second)
    assert (out / "file").read_bytes() == b"first"
    assert names(tmp_path) == ["out"]


def test_a_failed_replacement_restores_the_old_folder(tmp_path, monkeypatch):
    out = tmp_path / "out"
    with new_folder(out) as folder:
        (folder / "file").write_bytes(b"old")
    rename = Path.rename

    def fail_for_new_folder(self, target):
        if self.name.endswith(".part"):
            fail_with(errno.EIO)()
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_for_new_folder)
    with pytest.raises(InputError, match="Input/output error"):
        fill(out, lambda folder: (folder / "file").write_bytes(b"new"), overwrite=True)
    assert (out / "file").read_bytes() == b"old"
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_current_folder_is_not_replaced(tmp_path, monkeypatch, overwrite):
    here = tmp_path / "above" / "here"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    for path in (".", here, "..", tmp_path):
        with pytest.raises(InputError, match=r"is the folder you are in.*name a folder inside it"):
            fill(path, lambda folder: None, overwrite=overwrite)
    fill("inside", lambda folder: None)
    fill("../beside", lambda folder: None)
    assert names(tmp_path / "above") == ["beside", "here"]
    assert names(here) == ["inside"]


def test_a_file_at_the_place_of_a_folder(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="is a file, not a folder"):
        new_folder(tmp_path / "file", overwrite=True).__enter__()
    with pytest.raises(InputError, match="a part of its path is a file"):
        new_folder(tmp_path / "file" / "out").__enter__()
    with pytest.raises(InputError, match="a part of its path is a file"):
        write_whole(tmp_path / "file" / "out", b"")


WRITES = [
    lambda path: write_whole(path, b""),
    lambda path: fill(path, lambda folder: None),
    lambda path: check_new_file(Path(path), overwrite=True),
    lambda path: check_replaceable(path, overwrite=True),
    check_writable,
]


@pytest.mark.parametrize("write", WRITES)
def test_paths_that_cannot_be_written(tmp_path, monkeypatch, write):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    long = "n" * 256
    cases = {
        "loop": r"loop: cannot be written: Too many levels of symbolic links \(a symbolic link of its path",
        "loop/out": "loop/out: cannot be written: Too many levels of symbolic links",
        long: r"cannot be written: File name too long \(choose a shorter name\)",
        "/".join(["deep" * 50] * 30): "cannot be written: File name too long",
        "a\0b": r"a\\x00b: contains a character that no file name has",
        "\ud800": "contains a character that no file name has",
    }
    for path, message in cases.items():
        with pytest.raises(InputError, match=message) as caught:
            write(path)
        assert str(caught.value).startswith(path[:10] if path.isprintable() else "")
    assert names(tmp_path) == ["loop"]


def test_messages_name_the_path_of_the_user(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to(tmp_path)
    monkeypatch.setattr(os, "fsync", fail_with(errno.ENOSPC))
    with pytest.raises(InputError, match=r"^link/out/poses\.npz: cannot be written: No space left"):
        fill("link/out", lambda folder: write_whole(folder / "poses.npz", b""))
    with pytest.raises(InputError, match=r"^link/out: cannot be written: No space left"):
        fill("link/out", lambda folder: (folder / "file").write_bytes(b""))
    with pytest.raises(InputError, match=r"^link/file: cannot be written: No space left"):
        write_whole("link/file", b"")


def test_a_name_of_the_greatest_length(tmp_path):
    for name in ("n" * 255, "é" * 127):
        write_whole(tmp_path / name, b"")
        with new_folder(tmp_path / "folder" / name):
            pass
