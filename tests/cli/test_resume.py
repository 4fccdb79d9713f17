"""`reconstruct` continues after an interruption, and the result is that of an uninterrupted run."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
from support.cli_files import rejected
from support.interrupted import CONFIG, FOOTAGE, command, contents, stopping, toy_networks
from support.toy_footage import BIRD, FRAMES, TrueSegmenter

from jaxfit import pipeline
from jaxfit.cli.main import main
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.fitting.windows import window_hash
from jaxfit.foundation import files
from jaxfit.foundation.errors import InputError

FRAME_NUMBERS = list(range(FRAMES))


def prepare(folder):
    FOOTAGE.write_inputs(folder, CONFIG + "overlay: {write: false}\n")


def run(folder, point="never", stop=KeyboardInterrupt, *more):
    """Run the command; return the exit code and the frames that the segmenter received."""

    def stop_now():
        raise stop

    with toy_networks(TrueSegmenter(FOOTAGE)) as segmenter, stopping(point, stop_now):
        return main(command(folder, *more)), segmenter.frames


def stopped(result, first, stop):
    """Whether a run was interrupted after the frames `first` to `stop`; the segmenter runs up to 3 frames ahead."""
    code, frames = result
    last = first + len(frames)
    return code == 130 and frames == [*range(first, last)] and stop <= last <= min(stop + 3, FRAMES)


@contextmanager
def counting():
    """Return the hashes of the windows that are fitted and stored."""
    fitted, add = [], StoredWindows.add

    def added(self, windows, results, contents):
        fitted.extend(window_hash(windows, w, contents[w]) for w in results)
        add(self, windows, results, contents)

    with mock.patch.object(StoredWindows, "add", added):
        yield fitted


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The content of an uninterrupted result."""
    folder = tmp_path_factory.mktemp("whole")
    prepare(folder)
    assert run(folder) == (0, FRAME_NUMBERS)
    assert sorted(path.name for path in folder.iterdir()) == ["frames", "quick.yaml", "result", "toy.npz"]
    return contents(folder / "result")


@pytest.fixture
def folder(tmp_path):
    prepare(tmp_path)
    return tmp_path


def test_every_interruption_continues(folder, expected, caplog):
    """One run after the other stops later than the run before; what is stored is not computed again."""
    with counting() as fitted:
        assert run(folder, "frame 3")[0] == 130
        assert not (folder / "result.unfinished").exists()  # nothing was stored yet
        assert stopped(run(folder, "frame 7"), 0, 7)
        assert "result.unfinished holds the work so far; the same command continues there" in caplog.text
        assert stopped(run(folder, "part 1"), 5, 10)
        assert stopped(run(folder, "frame 11"), 5, 11)
        assert run(folder, "part 2") == (130, [10, 11])
        assert not fitted
        assert run(folder, "windows 1") == (130, [10, 11])
        assert len(fitted) == 4  # of six windows; a part holds four
        assert run(folder, "result") == (130, [])
        assert not (folder / "result").exists()
        assert run(folder) == (0, [])
    assert len(fitted) == len(set(fitted)) == 6
    assert contents(folder / "result") == expected
    assert not (folder / "result.unfinished").exists()


@pytest.mark.extended
def test_a_failed_fit_keeps_the_tracking_and_accepts_other_settings(folder, expected, caplog):
    with mock.patch("jaxfit.fitting.tasks.fit_batch", side_effect=InputError("config", "needs memory", "lower it")):
        assert run(folder) == (2, FRAME_NUMBERS)
    text = (folder / "quick.yaml").read_text()
    (folder / "quick.yaml").write_text(
        text.replace("pose_prior: 0.1", "pose_prior: 0.2").replace("frames: 3", "frames: 2")
    )
    assert run(folder, "windows 1") == (130, [])  # for the frames that are stored
    caplog.clear()
    (folder / "quick.yaml").write_text(text.replace("pose_prior: 0.1", "pose_prior: 0.3"))
    assert run(folder)[0] == 2
    assert not caplog.messages
    shutil.rmtree(folder / "result.unfinished" / "windows")
    (folder / "quick.yaml").write_text(text)
    assert run(folder) == (0, [])
    assert contents(folder / "result") == expected


def test_other_inputs_are_refused(folder, capsys):
    assert run(folder, "frame 7")[0] == 130
    with toy_networks(TrueSegmenter(FOOTAGE)):
        refused = "result.unfinished/frames: was begun with another "
        words = refused + "track.frames.stop (", "remove this folder"
        rejected(capsys, command(folder, "--stop", "9"), *words, alone=False)
        (folder / "frames" / "11.png").unlink()
        rejected(capsys, command(folder), refused + "video.content (", alone=False)
        (folder / "frames").rename(folder / "others")
        FOOTAGE.write(folder / "frames")
        part = folder / "result.unfinished" / "frames" / "000000.npz"
        part.write_bytes(part.read_bytes()[:-30])
        rejected(capsys, command(folder), "frames/000000.npz: is not an .npz file", "remove this file", alone=False)
        part.unlink()
        assert main(command(folder)) == 0


def test_the_same_command_with_other_networks_begins_again(folder, caplog):
    """The segmenter that `auto` stands for depends on the files that are there."""
    assert run(folder, "frame 7")[0] == 130
    with mock.patch.object(pipeline, "file_hashes", return_value={"segmenter": {"new.onnx": "0"}}):
        assert stopped(run(folder, "frame 9"), 0, 9)
    assert "result.unfinished/frames: was begun with another networks.segmenter" in caplog.text
    assert ", so the work begins again" in caplog.text


@pytest.mark.extended
def test_a_full_disk_costs_nothing_that_was_stored(folder, expected, capsys):
    sync = files._sync
    count = []

    def full(path):
        count.append(path)
        if len(count) > 4:  # the record and the first part
            raise OSError(28, os.strerror(28))
        sync(path)

    with mock.patch.object(files, "_sync", full), toy_networks(TrueSegmenter(FOOTAGE)):
        words = "result.unfinished/frames/000001.npz: cannot be written: No space left on device", "free some space"
        rejected(capsys, command(folder), *words, alone=False)
    assert run(folder) == (0, FRAME_NUMBERS[5:])
    assert contents(folder / "result") == expected


def test_footage_without_birds_leaves_nothing(folder):
    with toy_networks(TrueSegmenter(FOOTAGE, [(t, n) for t in range(FRAMES) for n in range(3)])):
        assert main(command(folder)) == 2
    assert not (folder / "result.unfinished").exists()


@pytest.mark.extended
@pytest.mark.parametrize("point", ["frame 7", "windows 1", "result"])
def test_a_killed_process(folder, expected, point):
    """The process is killed with SIGKILL, so no code of its own cleans up. The process of the tests continues."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    run_it = [sys.executable, "-m", "support.interrupted", str(folder), point]
    killed = subprocess.run(run_it, env=environment, capture_output=True, check=False)
    assert killed.returncode == -9
    assert list((folder / "result.unfinished").rglob("*.npz"))
    assert run(folder)[0] == 0
    assert contents(folder / "result") == expected
    assert sorted(path.name for path in folder.iterdir() if path.name != "cache") == [
        *("frames", "quick.yaml", "result", "toy.npz")
    ]


@pytest.mark.extended
def test_networks_of_the_caller_are_not_stored(folder):
    from jaxfit.config.reconstruct import load_reconstruct_config

    config = load_reconstruct_config(folder / "quick.yaml")
    segmenter = TrueSegmenter(FOOTAGE)
    with toy_networks(segmenter), stopping("result", lambda: (_ for _ in ()).throw(KeyError)):
        for _ in range(2):
            with pytest.raises(KeyError), counting() as fitted:
                pipeline.reconstruct(folder / "frames", folder / "result", BIRD, config, segmenter)
    assert segmenter.frames == FRAME_NUMBERS * 2
    assert not fitted  # in the second call
    assert not (folder / "result.unfinished" / "frames").exists()
