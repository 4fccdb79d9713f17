"""Checkpoints are read exactly; no file can run code or read outside its content."""

import os
import pickle
import zipfile

import numpy as np
import pytest
from support.checkpoints import integers, legacy, mapping, storage, tensor, text, write_legacy, write_zip

from jaxfit.foundation.errors import InputError
from jaxfit.model.torch_file import read_tensors

RAW = np.arange(12, dtype="<f4").tobytes()
FLOATS = {"0": RAW}
STORED = storage("0", 12)


@pytest.mark.parametrize("write", [write_legacy, write_zip])
def test_arrays_come_back_exactly(tmp_path, write):
    rng = np.random.default_rng(0)
    expected = {
        "f": rng.normal(size=(3, 4)).astype("<f4"),
        "d": rng.normal(size=(2, 2, 2)),
        "h": rng.normal(size=5).astype("<f2"),
        "l": np.array([-(2**40), 2**40]),
        "u": np.arange(3, dtype="u1"),
        "scalar": np.array(2.5),
        "empty": np.zeros((0, 3), "<f4"),
    }
    tensors = read_tensors(write(tmp_path / "a.pt", expected))
    assert tensors.keys() == expected.keys()
    for name, array in expected.items():
        assert tensors[name].dtype == array.dtype, name
        np.testing.assert_array_equal(tensors[name], array)


def test_views_share_a_storage(tmp_path):
    entries = {
        "transposed": tensor(STORED, (4, 3), (1, 4)),
        "column": tensor(STORED, (3,), (4,), offset=2),
        "last": tensor(STORED, (3,), (5,), offset=1),
    }
    (tmp_path / "a.pt").write_bytes(legacy(mapping(entries), FLOATS))
    tensors = read_tensors(tmp_path / "a.pt")
    whole = np.arange(12).reshape(3, 4)
    np.testing.assert_array_equal(tensors["transposed"], whole.T)
    np.testing.assert_array_equal(tensors["column"], whole[:, 2])
    np.testing.assert_array_equal(tensors["last"], [1, 6, 11])
    assert not tensors["column"].flags.writeable


def read_error(tmp_path, content: bytes) -> str:
    path = tmp_path / "damaged.pt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged\.pt") as caught:
        read_tensors(path)
    return str(caught.value)


class Payload:
    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_code_in_a_pickle_is_never_run(tmp_path, protocol):
    canary, control = tmp_path / "canary", tmp_path / "control"
    pickle.loads(pickle.dumps(Payload(str(control)), protocol))
    assert control.exists()  # the payload does run where a pickle is trusted
    payload = pickle.dumps({"V": Payload(str(canary))}, protocol)
    assert "mkdir, which is not a tensor; no code was run" in read_error(tmp_path, legacy(payload, {}))
    assert "no code was run" in read_error(tmp_path, payload)  # at the very first pickle
    with zipfile.ZipFile(tmp_path / "damaged.pt", "w") as archive:
        archive.writestr("archive/data.pkl", payload)
    with pytest.raises(InputError, match="no code was run"):
        read_tensors(tmp_path / "damaged.pt")
    assert not canary.exists()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"cbuiltins\neval\n" + b"(" + text("1") + b"tR.", "refers to builtins.eval"),
        (b"\x80\x04\x8c\x05posix\x8c\x06system\x93.", "refers to posix.system"),
        (b"\x80\x04" + text("torch") + text("FloatStorage.__init__") + b"\x93.", "__init__, which is not a tensor"),
        (b"(ios\nsystem\n.", "refers to os.system"),
        (b"\x82\x01.", "unregistered extension code"),
        (b"ctorch\nFloatStorage\n" + integers([2**40]) + b"R.", "not callable"),
        (mapping({"V": b"ctorch._utils\n_rebuild_tensor_v2\n(" + text("x") * 6 + b"tR"}), ""),
        (b".", ""),
        (b"](" + STORED + b"e.", "a dictionary of tensors"),
        (storage("0", 12, "BFloat16") + b".", "torch.BFloat16Storage"),
        (mapping({"V": storage("0", 12, tail=integers([1, 0, 2]))}), "view"),
    ],
)
def test_other_content_is_refused(tmp_path, body, message):
    assert message in read_error(tmp_path, legacy(body, FLOATS))


@pytest.mark.parametrize(
    ("shape", "strides", "offset"),
    [
        ((13,), (1,), 0),
        ((12,), (1,), 1),
        ((3, 4), (5, 1), 0),
        ((2,), (2**40,), 0),
        ((2,), (-1,), 0),
        ((-1,), (1,), 0),
        ((3,), (1,), -1),
        ((2**62, 4), (0, 0), 0),
        ((3,), (1, 1), 0),
    ],
)
def test_a_tensor_stays_inside_its_storage(tmp_path, shape, strides, offset):
    assert "checkpoint" in read_error(tmp_path, legacy(mapping({"V": tensor(STORED, shape, strides, offset)}), FLOATS))


def test_stated_sizes_must_agree_with_the_content(tmp_path):
    body = mapping({"V": tensor(STORED, (12,), (1,))})
    assert "storage 0 has 11 numbers, its tensors expect 12" in read_error(
        tmp_path, legacy(body, FLOATS, counts={"0": 11})
    )
    assert read_error(tmp_path, legacy(body, FLOATS)[:-1])
    assert read_error(tmp_path, legacy(body, {}))
    assert "little-endian" in read_error(tmp_path, legacy(body, FLOATS, little=False))
    assert read_error(tmp_path, b"")
    whole = write_zip(tmp_path / "a.pt", {"V": np.zeros(1000, "<f4")}).read_bytes()
    assert read_error(tmp_path, whole[:-40])
    flipped = bytearray(whole)
    flipped[whole.index(b"\0" * 1000) + 500] ^= 1
    assert "CRC" in read_error(tmp_path, bytes(flipped))
