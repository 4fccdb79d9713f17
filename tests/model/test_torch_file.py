"""Checkpoints are read exactly; no file can run code, read outside its content, or exhaust the memory."""

import os
import pickle
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from support.checkpoints import (
    integer,
    integers,
    legacy,
    mapping,
    storage,
    tensor,
    text,
    write_legacy,
    write_zip,
)
from support.hostile import Isolated, many_examples
from support.mutations import damaged_bytes

from jaxfit.foundation.errors import InputError
from jaxfit.model.torch_file import read_tensors

RAW = np.arange(12, dtype="<f4").tobytes()
FLOATS = {"0": RAW}
STORED = storage("0", 12)


def arrays():
    rng = np.random.default_rng(0)
    return {
        "f": rng.normal(size=(3, 4)).astype("<f4"),
        "d": rng.normal(size=(2, 2, 2)),
        "h": rng.normal(size=5).astype("<f2"),
        "l": np.array([-(2**40), 2**40]),
        "u": np.arange(3, dtype="u1"),
        "scalar": np.array(2.5),
        "empty": np.zeros((0, 3), "<f4"),
    }


@pytest.mark.parametrize("write", [write_legacy, write_zip])
def test_arrays_come_back_exactly(tmp_path, write):
    expected = arrays()
    tensors = read_tensors(write(tmp_path / "a.pt", expected))
    assert tensors.keys() == expected.keys()
    for name, array in expected.items():
        assert tensors[name].dtype == array.dtype, name
        np.testing.assert_array_equal(tensors[name], array)


def test_views_share_a_storage(tmp_path):
    entries = {"transposed": tensor(STORED, (4, 3), (1, 4)), "column": tensor(STORED, (3,), (4,), offset=2)}
    (tmp_path / "a.pt").write_bytes(legacy(mapping(entries), FLOATS))
    tensors = read_tensors(tmp_path / "a.pt")
    whole = np.arange(12).reshape(3, 4)
    np.testing.assert_array_equal(tensors["transposed"], whole.T)
    np.testing.assert_array_equal(tensors["column"], whole[:, 2])
    assert not tensors["column"].flags.writeable


def read_error(tmp_path, content: bytes) -> str:
    path = tmp_path / "hostile.pt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"hostile\.pt") as caught:
        read_tensors(path)
    return str(caught.value)


class Payload:
    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("protocol", range(6))
def test_code_in_a_pickle_is_never_run(tmp_path, protocol):
    canary, control = tmp_path / "canary", tmp_path / "control"
    pickle.loads(pickle.dumps(Payload(str(control)), protocol))
    assert control.exists()  # the payload does run where a pickle is trusted
    payload = pickle.dumps({"V": Payload(str(canary))}, protocol)
    legacy_message = read_error(tmp_path, legacy(payload, {}))
    if protocol >= 2:
        assert "mkdir" in legacy_message
    assert read_error(tmp_path, payload)  # at the very first pickle
    with zipfile.ZipFile(tmp_path / "hostile.pt", "w") as archive:
        archive.writestr("archive/data.pkl", payload)
    with pytest.raises(InputError):
        read_tensors(tmp_path / "hostile.pt")
    assert not canary.exists()


BUILD_DICT = b"ccollections\nOrderedDict\n)R}(" + text("__class__") + b"K\x01ub"
HOSTILE_BODIES = {
    "eval": (b"cbuiltins\neval\n" + b"(" + text("1") + b"tR.", "builtins.eval"),
    "stack global": (b"\x80\x04\x8c\x05posix\x8c\x06system\x93.", "posix.system"),
    "copyreg": (b"ccopyreg\n_reconstructor\n.", "copyreg._reconstructor"),
    "torch itself": (b"ctorch\nload\n.", "torch.load"),
    "dotted name": (b"\x80\x04" + text("torch") + text("FloatStorage.__init__") + b"\x93.", "__init__"),
    "INST": (b"(ios\nsystem\n.", "INST"),
    "OBJ": (b"(cos\nsystem\no.", "os.system"),
    "NEWOBJ": (b"ccollections\nOrderedDict\n)\x81.", "NEWOBJ"),
    "EXT1": (b"\x82\x01.", "EXT1"),
    "BUILD": (BUILD_DICT + b".", "BUILD"),
    "BUILD on a tensor": (tensor(STORED, (12,), (1,)) + b"}b.", "BUILD"),
    "text persistent id": (b"Pstorage\n.", "PERSID"),
    "ordered dict of something": (b"ccollections\nOrderedDict\n((lt(R.", ""),
    "ordered dict with a tuple": (b"ccollections\nOrderedDict\n" + integers([1]) + b"R.", "calls something"),
    "call of a storage type": (b"ctorch\nFloatStorage\n" + integers([2**40]) + b"R.", "calls something"),
    "call of a text": (text("print") + b")R.", "calls something"),
    "tensor of text": (
        mapping({"V": b"ctorch._utils\n_rebuild_tensor_v2\n(" + text("x") * 6 + b"tR"}),
        "calls",
    ),
    "persistent id of numbers": (integers([1, 2, 3, 4, 5]) + b"Q.", "persistent id"),
    "empty stack": (b"0.", ""),
    "lone stop": (b".", ""),
    "unset memo": (b"h\x07.", ""),
    "no mark": (b"t.", ""),
    "key that is a tuple": (b"}((I1\nI2\ntI3\nu.", "names"),
    "unending": (b"\x80\x02" + b"K\x01" * 20, ""),
    "too long": (b"K\x01" * 200_002 + b".", "longer than"),
    "text longer than the file": (b"X\xff\xff\xff\x7fabc.", ""),
    "not UTF-8": (b"X\x01\x00\x00\x00\xff.", ""),
    "no dictionary": (b"](" + STORED + b"e.", "dictionary"),
    "bfloat16": (storage("0", 12, "BFloat16") + b".", "torch.BFloat16Storage"),
    "view of a storage": (mapping({"V": storage("0", 12, tail=integers([1, 0, 2]))}), "view"),
}


def test_hostile_opcodes_are_rejected(tmp_path):
    for name in HOSTILE_BODIES:
        body, expected = HOSTILE_BODIES[name]
        assert expected in read_error(tmp_path, legacy(body, FLOATS))


def test_a_tensor_stays_inside_its_storage(tmp_path):
    for shape, strides, offset in [
        ((13,), (1,), 0),
        ((12,), (1,), 1),
        ((3, 4), (5, 1), 0),
        ((2,), (2**40,), 0),
        ((2,), (-1,), 5),
        ((-1,), (1,), 0),
        ((3,), (1,), -1),
        ((0,), (1,), 13),
        ((2**20, 2**20), (0, 0), 0),
        ((2**62, 4), (0, 0), 0),
        ((3,), (1, 1), 0),
        ((1,) * 9, (1,) * 9, 0),
    ]:
        body = mapping({"V": tensor(STORED, shape, strides, offset)})
        assert "checkpoint" in read_error(tmp_path, legacy(body, FLOATS))


def test_the_last_element_may_be_used(tmp_path):
    (tmp_path / "a.pt").write_bytes(legacy(mapping({"V": tensor(STORED, (3,), (5,), 1)}), FLOATS))
    np.testing.assert_array_equal(read_tensors(tmp_path / "a.pt")["V"], [1, 6, 11])


def test_stated_sizes_must_agree_with_the_content(tmp_path):
    body = mapping({"V": tensor(STORED, (12,), (1,))})
    assert "disagree" in read_error(tmp_path, legacy(body, FLOATS, counts={"0": 11}))
    assert "disagree" in read_error(tmp_path, legacy(body, FLOATS, counts={"0": -1}))
    assert "truncated" in read_error(tmp_path, legacy(body, FLOATS)[:-1])
    assert "not in the file" in read_error(tmp_path, legacy(body, {}))
    assert "no tensor uses" in read_error(tmp_path, legacy(body, {"0": RAW, "1": RAW}))
    big = mapping({"V": tensor(storage("0", 2**27), (1,), (1,))})
    assert "truncated" in read_error(tmp_path, legacy(big, FLOATS, counts={"0": 2**27}))
    twice = mapping({"V": tensor(STORED, (1,), (1,)), "W": tensor(storage("0", 6, "Double"), (1,), (1,))})
    assert "two ways" in read_error(tmp_path, legacy(twice, FLOATS))
    assert "little-endian" in read_error(tmp_path, legacy(body, FLOATS, little=False))
    assert read_error(tmp_path, b"")
    assert read_error(tmp_path, b"\x80\x02}." * 5)


def test_small_files_cannot_exhaust_the_memory(tmp_path):
    bodies = [
        b"r\xff\xff\xff\x7f.",  # a memo of 2³¹ entries
        b"\x8e" + (2**62).to_bytes(8, "little") + b".",
        b"\x80\x04\x95" + (2**62).to_bytes(8, "little") + b".",
        integer(2**40) + b"\x85" * 190_000 + b".",
    ]
    tracemalloc.start()
    for body in bodies:
        read_error(tmp_path, legacy(body, {}))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**26


def test_zip_files_are_checked(tmp_path):
    path = tmp_path / "hostile.pt"
    whole = write_zip(path, {"V": np.zeros(1000, "<f4")}).read_bytes()
    assert "damaged" in read_error(tmp_path, whole[:-40])
    flipped = bytearray(whole)
    flipped[whole.index(b"\0" * 1000) + 500] ^= 1
    assert "damaged" in read_error(tmp_path, bytes(flipped))
    assert "compressed" in read_error(
        tmp_path, write_zip(path, {"V": np.zeros(9)}, compression=zipfile.ZIP_DEFLATED).read_bytes()
    )
    np.savez(tmp_path / "plain.npz", V=np.zeros(3))
    assert "data.pkl" in read_error(tmp_path, (tmp_path / "plain.npz").read_bytes())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", mapping({"V": tensor(storage("../../etc", 2, tail=b""), (1,), (1,))}))
    assert "../../etc" in read_error(tmp_path, path.read_bytes())  # a name in the archive is not used as a path
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", mapping({"V": tensor(storage("0", 3, tail=b""), (1,), (1,))}))
        archive.writestr("a/data/0", b"\0" * 8)
    assert "truncated" in read_error(tmp_path, path.read_bytes())


def test_missing_files_and_folders(tmp_path):
    for path in (tmp_path, tmp_path / "none.pt"):
        with pytest.raises(InputError, match=r"does not exist|is a folder"):
            read_tensors(path)


@pytest.mark.parametrize("write", [write_legacy, write_zip])
def test_any_damage_is_one_error(tmp_path, write):
    """For any damage, the reader returns arrays or raises InputError, within a bound on memory."""
    path = tmp_path / "a.pt"
    whole = write(path, {"V": np.ones((4, 3), "<f4"), "F": np.array([[0, 1, 2]])}).read_bytes()
    with Isolated("jaxfit.model.torch_file:read_tensors", memory_mb=30) as reader:

        @many_examples
        @given(damaged_bytes(whole))
        def check(content):
            path.write_bytes(content)
            outcome = reader(path)
            assert outcome.acceptable, outcome

        check()
