"""Arrays are read from `.npz` files, and damaged files give one clear error."""

import io
import zipfile

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.storage.npz import load_npz, npz_names


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def test_reads_arrays(tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(x=np.eye(3), names=np.array(["a", "ü"]), extra=np.int64(4)))
    assert npz_names(tmp_path / "a.npz") == {"x", "names", "extra"}
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
        (b"not a zip at all", "of plain arrays"),
        (npz(x=np.eye(30))[:-40], "is not a readable .npz"),
        (npz(x=np.eye(30))[:200], "is not a readable .npz"),
        (
            npz(x=np.random.default_rng(0).random(99)).replace(b"\x00\x00\x00\x00", b"\x07\x00\x09\x00"),
            "not a read",
        ),
        (raw(np.eye(3)), "holds one bare array"),
        (raw(np.array([{}], dtype=object)), "of plain arrays"),
        (npz(x=np.array([{}, 3], dtype=object)), "of plain arrays"),
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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a readable .npz"),
        (npz(x=np.eye(30))[:-40], "is not a readable .npz"),
        (raw(np.eye(3)), "holds one bare array"),
        (b"not a zip at all", "of plain arrays"),
    ],
    ids=range(4),
)
def test_names_of_damaged_files(tmp_path, content, message):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        npz_names(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_npz_names_does_not_read_the_arrays(tmp_path):
    (tmp_path / "a.npz").write_bytes(zipped(HUGE))
    assert npz_names(tmp_path / "a.npz") == {"x"}


def test_missing_files_and_folders(tmp_path):
    for read in (npz_names, lambda path: load_npz(path, {})):
        with pytest.raises(InputError, match="does not exist"):
            read(tmp_path / "absent.npz")
        with pytest.raises(InputError, match="is a folder"):
            read(tmp_path)
