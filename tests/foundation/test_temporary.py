"""What a killed process leaves is removed by the next write, and nothing of a living process."""

import os
import platform
import subprocess
import sys
import time

import pytest

from jaxfit.foundation import files as module
from jaxfit.foundation.files import check_writable, new_file, new_folder, remove_leftovers, write_whole

WRITER = """
import os, signal, sys
from pathlib import Path
from jaxfit.foundation.files import new_file, new_folder, write_whole

folder, replaced = Path(sys.argv[1]), Path(sys.argv[2])
rename = Path.rename

def kill_after(self, target):
    rename(self, target)
    if str(target).endswith(".old"):
        os.kill(os.getpid(), signal.SIGKILL)

with new_folder(folder / "a") as part, new_file(folder / "b.mp4") as file, new_file(part / "c") as inner:
    file.write_bytes(b"half")
    inner.write_bytes(b"half")
    print("ready", flush=True)
    sys.stdin.readline()
    Path.rename = kill_after
    with new_folder(replaced, overwrite=True) as other:
        (other / "new").write_bytes(b"new")
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def writer(tmp_path):
    """A process that writes `a/` and `b.mp4`, and dies in the replacement of `r/` when it receives a line."""
    write_whole(tmp_path / "r" / "old", b"old")
    command = [sys.executable, "-c", WRITER, str(tmp_path), str(tmp_path / "r")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


def test_a_killed_process_leaves_nothing(tmp_path, writer):
    during = names(tmp_path)
    assert len(during) == 5  # two temporary names with their locks, and r
    check_writable(tmp_path / "a")
    write_whole(tmp_path / "d", b"")
    with new_folder(tmp_path / "e"):
        pass
    assert names(tmp_path) == sorted([*during, "d", "e"])  # the process lives, so its files stay
    writer.communicate("die\n")
    assert not (tmp_path / "r").exists()
    check_writable(tmp_path / "x")
    assert names(tmp_path) == ["d", "e", "r"]
    assert names(tmp_path / "r") == ["old"]  # the replacement was interrupted between two renames


def test_a_replacement_that_was_interrupted_after_its_last_rename(tmp_path, writer):
    writer.communicate("die\n")
    write_whole(tmp_path / "r" / "other", b"")  # in r, so that the leftovers beside r stay
    remove_leftovers(tmp_path)
    assert names(tmp_path) == ["r"]
    assert names(tmp_path / "r") == ["other"]


def leave(folder, name="x", host=None, age_days=0.0, content=None):
    """Write what a killed process leaves."""
    lock, part = folder / f".{name}.0123abcd.lock", folder / f".{name}.0123abcd.part"
    lock.write_bytes(f"jaxfit\n{host or platform.node()}\n{name}".encode() if content is None else content)
    part.mkdir()
    (part / "file").write_bytes(b"")
    for path in (lock, part):
        os.utime(path, (time.time() - age_days * 86400,) * 2)
    return [lock.name, part.name]


def test_files_of_others_stay(tmp_path):
    left = leave(tmp_path, host="another-computer", age_days=6)
    left += leave(tmp_path, name="y", content=b"not of jaxfit")
    left += leave(tmp_path, name="z", content=b"")
    (tmp_path / ".w.0123abcd.part").write_bytes(b"of another program")
    os.mkfifo(tmp_path / ".fifo.0123abcd.lock")
    (tmp_path / ".link.0123abcd.lock").symlink_to(tmp_path / "absent")
    left += [".w.0123abcd.part", ".fifo.0123abcd.lock", ".link.0123abcd.lock"]
    remove_leftovers(tmp_path)
    assert names(tmp_path) == sorted(left)


def test_old_files_of_another_computer_are_removed(tmp_path):
    leave(tmp_path, host="another-computer", age_days=8)
    (tmp_path / ".y.0123abcd.lock").write_bytes(b"")  # killed before anything was written
    leave(tmp_path, name="n\nm")
    remove_leftovers(tmp_path)
    assert names(tmp_path) == []
    remove_leftovers(tmp_path / "absent")


def test_a_link_is_removed_and_not_its_target(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis").write_bytes(b"precious")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".x.0123abcd.part").symlink_to(tmp_path / "home")
    (tmp_path / "out" / ".x.0123abcd.lock").write_bytes(f"jaxfit\n{platform.node()}\n../home".encode())
    remove_leftovers(tmp_path / "out")
    assert names(tmp_path / "out") == []
    assert names(tmp_path / "home") == ["thesis"]


def test_without_locks_nothing_is_removed_and_files_are_written(tmp_path, monkeypatch):
    left = leave(tmp_path)
    monkeypatch.setattr(module, "fcntl", None)
    with new_file(tmp_path / "file") as part:
        part.write_bytes(b"1")
        assert names(tmp_path) == sorted([*left, part.name])
    assert names(tmp_path) == sorted([*left, "file"])
