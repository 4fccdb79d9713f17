"""Arrays are read from `.npz` files, and damaged files give one clear error."""

import io
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import given
from support.hostile import Isolated, many_examples
from support.mutations import damaged_bytes, damaged_npz

from jaxfit.foundation.array_files import load_npy, load_npz, npz_names
from jaxfit.foundation.errors import InputError


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def test_reads_arrays(tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(x=np.eye(3), names=np.array(["a", "ü"]), extra=np.int64(4)))
    assert npz_names(tmp_path / "a.npz") == {"x", "names", "extra"}
    arrays = load_npz(tmp_path / "a.npz", {"x": "3 3", "names": "K"}, optional={"extra": "", "other": "N"})
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
            "x is damaged",
        ),
        (raw(np.eye(3)), "holds one bare array"),
        (raw(np.array([{}], dtype=object)), "holds one bare array"),
        (npz(x=np.array([{}, 3], dtype=object)), "x holds Python objects; jaxfit loads no pickles"),
        (zipped(HUGE), "x is damaged: an array of shape .* has another size"),
        (zipped(b"plain bytes"), "x is damaged: is not an array"),
        (npz(y=np.eye(3)), "lacks the array x"),
        (npz(x=np.ones(3)), r"x must have shape \(N, M\), not \(3,\)"),
    ],
    ids=range(12),
)
def test_damaged_arrays(tmp_path, content, message):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_npz(path, {"x": "N M"})
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


def compressed(entries, **options):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", options.get("method", zipfile.ZIP_DEFLATED)) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, content in entries:
            archive.writestr(name, content)
    return file.getvalue()


def header(text, version=1):
    size = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + text.encode()


def with_header(text, version=1):
    return compressed([("x.npy", header(text, version))])


def encrypted(content):
    central = content.rindex(b"PK\x01\x02") + 8
    return content[:central] + bytes([content[central] | 1]) + content[central + 1 :]


def lying(content, size):
    """The table of contents declares another size of the last array."""
    central = content.rindex(b"PK\x01\x02") + 24
    return content[:central] + size.to_bytes(4, "little") + content[central + 4 :]


FEW = raw(np.zeros(4, np.float32))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npz(x=np.zeros(3, complex)), "x holds complex128, expected real numbers"),
        (npz(x=np.zeros(3, "M8[s]")), "x holds datetime64"),
        (npz(x=np.zeros(3, "S3")), "x holds bytes24"),
        (npz(x=np.zeros(3, "f4,f4")), "x holds void64"),
        (npz(x=np.array(["a\nb"])), "x holds text that cannot be printed"),
        (npz(x=np.array(["\ud800"])), "x holds text that cannot be printed"),
        (npz(x=np.array(["a" * 1001])), "holds texts of 1001 characters; the limit is 1000"),
        (with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }"), "has a shape that no array has"),
        (with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }"), "has a shape that no array has"),
        (with_header("{'descr': '<U0', 'fortran_order': False, 'shape': (9,), }"), "texts of 0 characters"),
        (with_header("(" * 3000), "its header cannot be read"),
        (with_header("-" * 3000 + "1"), "its header cannot be read"),
        (
            with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (3L,), }" + " " * 4200),
            "header cannot be read",
        ),
        (with_header("x" * 4_000_000, 2), "its header cannot be read"),
        (with_header("{}", 3), "has a header of version 3.0"),
        (compressed([("x.npy", FEW)], method=zipfile.ZIP_LZMA), "a compression that numpy does not write"),
        (compressed([("x.npy", FEW)], method=zipfile.ZIP_BZIP2), "a compression that numpy does not write"),
        (encrypted(compressed([("x.npy", FEW)])), "x is damaged: is encrypted"),
        (lying(compressed([("x.npy", FEW)]), 2**31), "declares a size that its content cannot have"),
        (lying(compressed([("x.npy", FEW)]), len(FEW) + 4), "an array of shape .* has another size"),
        (compressed([("x.npy", FEW), ("x.npy", FEW)]), "holds the array x twice"),
        (compressed([("x.npy", FEW), ("x", FEW)]), "holds the array x twice"),
        (compressed([(f"{i}.npy", b"") for i in range(1001)]), "holds 1001 arrays; the limit is 1000"),
    ],
)
def test_hostile_arrays(tmp_path, content, message):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_npz(path, {"x": "N"})


def test_byte_order_and_axis_order(tmp_path):
    x = np.arange(6.0).reshape(2, 3)
    np.savez(tmp_path / "a.npz", x=np.asfortranarray(x).astype(">f8"), old=np.zeros(2, bool))
    arrays = load_npz(tmp_path / "a.npz", {"x": "2 N", "old": "2"})
    np.testing.assert_array_equal(arrays["x"], x)
    assert arrays["x"].dtype.isnative
    text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1L, 1), }"  # as Python 2 writes
    (tmp_path / "a.npz").write_bytes(compressed([("x.npy", header(text) + bytes(8))]))
    assert load_npz(tmp_path / "a.npz", {"x": "N N"})["x"].shape == (1, 1)


def test_a_single_array(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.eye(3))
    np.testing.assert_array_equal(load_npy(path), np.eye(3))
    mapped = load_npy(path, "3 N", mapped=True, max_bytes=1)
    np.testing.assert_array_equal(mapped, np.eye(3))
    with pytest.raises(InputError, match="take 0 MB in memory; the limit is 0 MB"):
        load_npy(path, max_bytes=1)
    for content, message in (
        (FEW, "the array must have shape"),
        (FEW[:-1], "not a readable .npy: an array of shape"),
        (raw(np.array([{}], dtype=object)), "jaxfit loads no pickles"),
        (b"", "the file is empty"),
        (npz(x=np.eye(3)), "is an .npz, not one bare array"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_npy(path, "3 3")


def bomb(path, wanted):
    """Write 3 GB of zeros as two arrays in 3 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("a", wanted):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array_header_1_0(
                    file, {"descr": "<f8", "fortran_order": False, "shape": (3 * 2**26,)}
                )
                for _ in range(96):
                    file.write(bytes(2**24))


@pytest.mark.extended
def test_bombs(tmp_path):
    bomb(tmp_path / "needed.npz", "x")
    with Isolated("jaxfit.foundation.array_files:load_npz", memory_mb=20) as reader:
        outcome = reader(tmp_path / "needed.npz", {"x": "N"})
        assert outcome.acceptable, outcome
        assert "its arrays take 1,611 MB in memory; the limit is 1,074 MB" in outcome.message
        assert reader(tmp_path / "needed.npz", {}).acceptable


def test_any_damage_is_one_error(tmp_path):
    path, arrays = tmp_path / "a.npz", {"x": np.eye(3), "n": np.array(["a", "b"]), "format_version": np.int64(1)}
    with Isolated("jaxfit.foundation.array_files:load_npz", memory_mb=30) as reader:

        @many_examples
        @given(damaged_npz(npz(**arrays)))
        def check(content):
            path.write_bytes(content)
            outcome = reader(path, {"x": "A 3", "n": "B"}, 1)
            assert outcome.acceptable, outcome

        check()


def test_any_damage_of_a_single_array_is_one_error(tmp_path):
    with Isolated("jaxfit.foundation.array_files:load_npy", memory_mb=30) as reader:

        @many_examples
        @given(damaged_bytes(raw(np.eye(3))))
        def check(content):
            (tmp_path / "a.npy").write_bytes(content)
            outcome = reader(tmp_path / "a.npy", "A B")
            assert outcome.acceptable, outcome

        check()
