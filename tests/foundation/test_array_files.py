"""Arrays are read from `.npz` and `.npy` files and validated against a layout; damaged files give one clear error."""

import io
import zipfile

import numpy as np
import pytest

from jaxfit.foundation.array_files import load_npy, load_npz, npz_names, validate_arrays
from jaxfit.foundation.errors import InputError


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def zipped(content):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("x.npy", content)
    return file.getvalue()


HUGE = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999,), }".ljust(118)


def test_reads_arrays(tmp_path):
    path = tmp_path / "a.npz"
    swapped = np.asfortranarray(np.arange(6.0).reshape(2, 3)).astype(">f8")
    np.savez(path, x=swapped, names=np.array(["a", "ü"]), extra=np.int64(4), old=np.zeros(2, bool))
    assert npz_names(path) == {"x", "names", "extra", "old"}
    arrays = load_npz(path, {"x": "2 3", "names": "K"}, optional={"extra": "", "other": "N"})
    np.testing.assert_array_equal(arrays["x"], np.arange(6.0).reshape(2, 3))
    assert arrays["x"].dtype.isnative
    assert arrays["names"].tolist() == ["a", "ü"]
    assert arrays["extra"] == 4
    assert arrays.keys() == {"x", "names", "extra"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not an .npz file"),
        (b"not a zip at all", "of plain arrays"),
        (npz(x=np.eye(30))[:-40], "may be truncated"),
        (npz(x=np.eye(30))[9:], r"is not an .npz file of plain arrays \("),
        (npy(np.eye(3)), "is not an .npz file"),
        (npz(x=np.random.default_rng(0).random(99)).replace(b"\0\0\0\0", b"\7\0\t\0"), "that can be read"),
        (npz(x=np.array([{}, 3], dtype=object)), "Object arrays cannot be loaded"),
        (zipped(HUGE), "that can be read"),
        (zipped(b"plain bytes"), "x holds no array"),
        (npz(y=np.eye(3)), "lacks the array x"),
        (npz(x=np.ones(3)), r"x must have shape \(N, M\), not \(3,\)"),
        (npz(x=np.zeros(3, complex)), "x holds complex128, expected real numbers"),
        (npz(x=np.zeros(3, "S3")), "x holds |S3"),
    ],
    ids=range(13),
)
def test_damaged_arrays(tmp_path, content, message):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_npz(path, {"x": "N M"})
    assert str(caught.value).startswith(f"{path}: ")


def test_missing_files_and_folders(tmp_path):
    for read in (npz_names, load_npy, lambda path: load_npz(path, {})):
        with pytest.raises(InputError, match="does not exist"):
            read(tmp_path / "absent.npz")
        with pytest.raises(InputError, match="is a folder"):
            read(tmp_path)


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (None, "lacks the array format_version"),
        (1, "older than this jaxfit reads"),
        (4, "newer than this jaxfit reads"),
        (2.0, "format_version is 2.0, expected an integer"),
        ([2], "format_version is of shape"),
    ],
)
def test_format_versions(tmp_path, version, message):
    stored = {} if version is None else {"format_version": version}
    np.savez(tmp_path / "a.npz", x=1, **stored)
    with pytest.raises(InputError, match=message):
        load_npz(tmp_path / "a.npz", {"x": ""}, version=3, oldest=2)


def test_a_single_array(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.eye(3))
    np.testing.assert_array_equal(load_npy(path), np.eye(3))
    np.testing.assert_array_equal(load_npy(path, "3 N", mapped=True), np.eye(3))
    for content, message in (
        (npy(np.zeros(4)), "the array must have shape"),
        (npy(np.zeros(4))[:-1], "that can be read"),
        (npy(np.array([{}], dtype=object)), "Object arrays cannot be loaded"),
        (b"", "that can be read"),
        (npz(x=np.eye(3)), "that can be read"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_npy(path, "3 3")


def test_layout_errors_name_the_arrays():
    layout = {"a": ("N 3", np.float32), "b": ("N", np.int64)}
    arrays = validate_arrays({"a": np.ones((2, 3), int), "b": [1, 2]}, layout)
    assert arrays["a"].dtype == np.float32
    with pytest.raises(ValueError, match=r"b must have shape \(N\), not \(3,\): axis 0 should be 2: N is 2 in a"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1, 2, 3]}, layout)
    with pytest.raises(ValueError, match="axis 1 should be 3"):
        validate_arrays({"a": np.ones((2, 4)), "b": [1, 2]}, layout)
    with pytest.raises(ValueError, match="b must be of type int64, not float64"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1.0, 2]}, layout)


def test_read_only_arrays_are_shared_and_others_are_copied():
    given = np.arange(3)
    assert not np.shares_memory(validate_arrays({"a": given}, {"a": ("N", np.int64)})["a"], given)
    given.flags.writeable = False
    assert validate_arrays({"a": given}, {"a": ("N", np.int64)})["a"] is given
    view = np.arange(5)[:3]  # its owner may be written to
    view.flags.writeable = False
    assert not np.shares_memory(validate_arrays({"a": view}, {"a": ("N", np.int64)})["a"], view)
    assert validate_arrays({"a": given}, {"a": ("N", np.float32)})["a"].dtype == np.float32
