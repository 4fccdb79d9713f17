"""The folder of unfinished work: one process at a time, kept after a failure."""

import subprocess
import sys

import numpy as np
import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.unfinished import Parts, unfinished_folder, unfinished_work

OWNER = """
import sys
from pathlib import Path
from jaxfit.foundation.unfinished import unfinished_work

with unfinished_work(Path(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.readline()
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def fail(reason):
    raise KeyError(reason)


def test_the_folder_goes_with_success_and_stays_with_a_failure(tmp_path):
    result = tmp_path / "deep" / "out"
    with pytest.raises(KeyError), unfinished_work(result):
        raise KeyError  # nothing was stored
    assert names(tmp_path) == []
    folder = unfinished_folder(result)
    assert folder == tmp_path / "deep" / "out.unfinished"
    with pytest.raises(KeyError), unfinished_work(result):
        fail(Parts(folder / "some", {}).add({"a": np.zeros(2)}))
    assert names(folder) == ["lock", "some"]
    with unfinished_work(result) as folder:
        assert Parts(folder / "some", {}).numbers == [0]
    assert names(tmp_path / "deep") == []


def test_a_second_process_is_refused_and_a_dead_one_is_not_in_the_way(tmp_path):
    command = [sys.executable, "-c", OWNER, str(tmp_path / "out")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        words = r"out\.unfinished: another jaxfit works on this result .*another --out"
        with pytest.raises(InputError, match=words), unfinished_work(tmp_path / "out"):
            pass
    finally:
        process.kill()
        process.communicate()
    assert names(tmp_path / "out.unfinished") == ["lock"]
    with unfinished_work(tmp_path / "out"):
        pass
    assert names(tmp_path) == []


def test_other_folders_are_not_touched(tmp_path):
    (tmp_path / "out.unfinished").mkdir()
    (tmp_path / "out.unfinished" / "thesis").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"out\.unfinished: holds files, but no lock.*remove this folder"):
        unfinished_work(tmp_path / "out").__enter__()
    assert names(tmp_path / "out.unfinished") == ["thesis"]
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match=r"a part of its path is a file"):
        unfinished_work(tmp_path / "file" / "out").__enter__()


def test_parts_are_numbered_and_read_back(tmp_path):
    parts = Parts(tmp_path / "p", {"a": {"b": 1, "c": [2]}})
    for i in range(3):
        parts.add({"x": np.full((2, 3), i), "text": np.array("é")})
    again = Parts(tmp_path / "p", {"a": {"b": 1, "c": [2]}})
    assert again.numbers == [0, 1, 2]
    loaded = again.load(1, {"x": "N 3", "text": ""})
    np.testing.assert_array_equal(loaded["x"], np.ones((2, 3)))
    assert loaded["text"] == "é"
    again.keep(1)
    again.add({"x": np.zeros(0)})
    read = Parts(tmp_path / "p", {"a": {"b": 1, "c": [2]}})
    assert (read.numbers, read.size_bytes) == ([0, 1], again.size_bytes)


def test_parts_of_another_computation_are_refused(tmp_path):
    Parts(tmp_path / "p", {"a": {"b": 1, "c": 2}, "v": 1}).add({"x": np.zeros(1)})
    with pytest.raises(InputError, match=r"p: was begun with another a\.b, v \(repeat the earlier command"):
        Parts(tmp_path / "p", {"a": {"b": 7, "c": 2}})
    with pytest.raises(InputError, match="was begun with another"):
        Parts(tmp_path / "p", {"a": {"b": 7, "c": 2}, "v": 2}, ("a",))
    many = {"a": {str(i): 0 for i in range(9)}, "v": 1}
    with pytest.raises(InputError, match=r"another a\.0, a\.1, a\.2 and 8 more"):
        Parts(tmp_path / "p", many)
    (tmp_path / "p" / "000000.npz").unlink()
    Parts(tmp_path / "p", {"new": 1}).add({"x": np.zeros(1)})  # a record without parts protects nothing
    assert Parts(tmp_path / "p", {"new": 1}).numbers == [0]
    (tmp_path / "p" / "record.json").write_text("{")
    with pytest.raises(InputError, match=r"record\.json: is not valid JSON"):
        Parts(tmp_path / "p", {"new": 1})
    (tmp_path / "p" / "record.json").unlink()
    with pytest.raises(InputError, match=r"record\.json: does not exist \(remove this folder"):
        Parts(tmp_path / "p", {"new": 1})


def test_parts_begin_again_if_only_renewed_values_differ(tmp_path, caplog):
    Parts(tmp_path / "p", {"a": {"b": 1}, "v": 1}).add({"x": np.zeros(1)})
    assert Parts(tmp_path / "p", {"a": {"b": 2}, "v": 1}, ("a.b",)).numbers == []
    assert caplog.messages == [f"{tmp_path / 'p'}: was begun with another a.b, so the work begins again"]
    assert list((tmp_path / "p").glob("*.npz")) == []


def test_every_flipped_bit_is_harmless_or_reported(tmp_path):
    """CRC-32 protects the content of every array; other bytes of a zip file cannot change an array."""
    parts = Parts(tmp_path / "p", {})
    arrays = {"x": np.arange(40.0), "text": np.array(["ab", "c"])}
    parts.add(arrays)
    path = tmp_path / "p" / "000000.npz"
    whole, rejected = path.read_bytes(), []
    for at in range(0, len(whole), 9):
        write_whole(path, whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        try:
            loaded = parts.load(0, {"x": "N", "text": "M"})
        except InputError as error:
            rejected.append(str(error))
        else:
            assert all((loaded[name] == arrays[name]).all() for name in arrays)
    assert len(rejected) > len(whole) / 27
    assert all("000000.npz" in text and "remove this file" in text for text in rejected)
    write_whole(path, whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"000000\.npz.*remove this file"):
        parts.load(0, {"x": "N", "text": "M"})
