"""Files and folders appear whole or not at all, and damaged arrays give one clear error."""

import errno
import io
import os
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.storage.arrays import validate_arrays
from jaxfit.storage.files import new_folder, write_whole
from jaxfit.storage.npz import load_npz


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


def test_a_symbolic_link_stays_one(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_whole(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_a_folder_or_device_is_no_file(tmp_path):
    for path in (tmp_path, Path("/dev/null")):
        with pytest.raises(InputError, match="is a folder or a device"):
            write_whole(path, b"")
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_refused_write_leaves_everything_as_it_was(tmp_path, monkeypatch, number):
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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_the_systems_own_full_disk(tmp_path):
    def content(file):
        file.write(b"half")
        with open("/dev/full", "wb", buffering=0) as full:  # noqa: PTH123
            full.write(b"the other half")

    with pytest.raises(InputError, match="No space left on device"):
        write_whole(tmp_path / "file", content)
    assert names(tmp_path) == []


@pytest.fixture
def tiny_disk(tmp_path):
    """A file system of 64 KiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("mounting a small disk is not allowed here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_fills_up(tiny_disk):
    with new_folder(tiny_disk / "results") as folder:
        (folder / "poses.npz").write_bytes(b"old")
    numbers = np.random.default_rng(0).random(100_000)
    with pytest.raises(InputError, match="results: cannot be written: No space left"):
        fill(tiny_disk / "results", lambda f: np.savez(f / "poses.npz", a=numbers), overwrite=True)
    with pytest.raises(InputError, match=r"file: cannot be written: No space left"):
        write_whole(tiny_disk / "file", bytes(100_000))
    assert names(tiny_disk) == ["results"]
    assert (tiny_disk / "results" / "poses.npz").read_bytes() == b"old"


def test_any_other_error_passes_through_and_leaves_nothing(tmp_path):
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


def test_a_folder_appears_at_the_end(tmp_path):
    out = tmp_path / "results" / "cliff"
    with new_folder(out) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "file").write_bytes(b"1")
        assert not out.exists()
    assert (out / "sub" / "file").read_bytes() == b"1"
    assert names(out.parent) == ["cliff"]


def test_results_are_not_overwritten_unasked(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with new_folder(out) as folder:  # an empty folder is nothing to protect
        (folder / "poses.npz").write_bytes(b"1")
    with pytest.raises(InputError, match=r"out: holds results already \(choose another --out or pass --overwrite\)"):
        new_folder(out).__enter__()
    with new_folder(out, overwrite=True, marker="poses.npz") as folder:
        (folder / "new").write_bytes(b"2")
        assert names(out) == ["poses.npz"]  # the old one stands until the new one is complete
    assert names(out) == ["new"]
    with pytest.raises(InputError, match=r"holds files, but no poses\.npz"):
        new_folder(out, overwrite=True, marker="poses.npz").__enter__()
    assert names(tmp_path) == ["out"]


def test_results_that_appear_meanwhile_are_kept(tmp_path):
    out = tmp_path / "out"

    def overtaken(folder):
        (folder / "file").write_bytes(b"second")
        out.mkdir()
        (out / "file").write_bytes(b"first")

    with pytest.raises(InputError, match="holds results already"):
        fill(out, overtaken)
    assert (out / "file").read_bytes() == b"first"
    assert names(tmp_path) == ["out"]


def test_a_failed_exchange_puts_the_old_folder_back(tmp_path, monkeypatch):
    out = tmp_path / "out"
    with new_folder(out) as folder:
        (folder / "file").write_bytes(b"old")
    rename = Path.rename

    def refuse_new(self, target):
        if self.name.endswith(".part"):
            fail_with(errno.EIO)()
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse_new)
    with pytest.raises(InputError, match="Input/output error"):
        fill(out, lambda folder: (folder / "file").write_bytes(b"new"), overwrite=True)
    assert (out / "file").read_bytes() == b"old"
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_current_folder_stays(tmp_path, monkeypatch, overwrite):
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


def test_a_file_stands_in_the_way(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="is a file, not a folder"):
        new_folder(tmp_path / "file", overwrite=True).__enter__()
    with pytest.raises(InputError, match="a part of its path is a file"):
        new_folder(tmp_path / "file" / "out").__enter__()
    with pytest.raises(InputError, match="a part of its path is a file"):
        write_whole(tmp_path / "file" / "out", b"")


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def test_reads_arrays_back(tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(x=np.eye(3), names=np.array(["a", "ü"]), extra=np.int64(4)))
    arrays = load_npz(tmp_path / "a.npz", {"x": 2, "names": 1})
    np.testing.assert_array_equal(arrays["x"], np.eye(3))
    assert arrays["names"].tolist() == ["a", "ü"]
    assert arrays["extra"] == 4


def raw(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def zipped(content):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("x.npy", content)
    return file.getvalue()


HUGE = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999,), }".ljust(118)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a readable .npz"),
        (b"not a zip at all", "is a pickle or holds Python objects"),
        (npz(x=np.eye(30))[:-40], "is not a readable .npz"),
        (npz(x=np.eye(30))[:200], "is not a readable .npz"),
        (
            npz(x=np.random.default_rng(0).random(99)).replace(b"\x00\x00\x00\x00", b"\x07\x00\x09\x00"),
            "not a read",
        ),
        (raw(np.eye(3)), "holds one bare array"),
        (raw(np.array([{}], dtype=object)), "is a pickle or holds Python objects"),
        (npz(x=np.array([{}, 3], dtype=object)), "is a pickle or holds Python objects"),
        (zipped(HUGE), "is not a readable .npz"),
        (zipped(b"plain bytes"), "lacks the array x"),
        (npz(y=np.eye(3)), "lacks the array x"),
        (npz(x=np.ones(3)), r"x has shape \(3,\), expected 2 dimensions"),
    ],
    ids=range(12),
)
def test_damaged_arrays(tmp_path, content, message):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_npz(path, {"x": 2})
    assert str(caught.value).startswith(f"{path}: ")


def test_what_is_no_file(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_npz(tmp_path / "absent.npz", {})
    with pytest.raises(InputError, match="is a folder"):
        load_npz(tmp_path, {})


def test_validate_arrays_names_the_array_that_disagrees():
    layout = {"a": ("N 3", np.float32), "b": ("N", np.int64)}
    arrays = validate_arrays({"a": np.ones((2, 3), int), "b": [1, 2]}, layout)
    assert arrays["a"].dtype == np.float32
    with pytest.raises(ValueError, match=r"b must have shape \(N\), not \(3,\): axis 0 should be 2: N is 2 in a"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1, 2, 3]}, layout)
    with pytest.raises(ValueError, match="axis 1 should be 3"):
        validate_arrays({"a": np.ones((2, 4)), "b": [1, 2]}, layout)
    with pytest.raises(ValueError, match="b must be of type int64, not float64"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1.0, 2]}, layout)
