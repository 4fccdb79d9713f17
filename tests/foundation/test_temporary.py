"""What a killed process leaves is removed by the next write, and nothing of a living process."""

import subprocess
import sys

import pytest

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


def test_files_of_others_stay(tmp_path):
    left = [".x.another-computer.0123abcd.lock", ".x.another-computer.0123abcd.part", ".y.0123abcd.part"]
    for name in left:
        (tmp_path / name).write_bytes(b"")
    remove_leftovers(tmp_path)
    assert names(tmp_path) == sorted(left)
    remove_leftovers(tmp_path / "absent")


def test_a_link_is_removed_and_not_its_target(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis").write_bytes(b"precious")
    (tmp_path / "out").mkdir()
    with new_file(tmp_path / "out" / "x") as part:
        stem = part.name.removesuffix(".part")
        part.write_bytes(b"")
    (tmp_path / "out" / f"{stem}.part").symlink_to(tmp_path / "home")
    (tmp_path / "out" / f"{stem}.lock").write_bytes(b"")
    remove_leftovers(tmp_path / "out")
    assert names(tmp_path / "out") == ["x"]
    assert names(tmp_path / "home") == ["thesis"]
