"""Networks on workers: the tracks are those of one process, and failures are one line or a warning."""

import dataclasses

import numpy as np
import pytest
from support.interrupted import CONFIG as CONFIG_OF_A_COMMAND
from support.interrupted import command, contents, toy_networks
from support.toy_footage import (
    BIRD,
    FRAMES,
    MISSED,
    BlockSegmenter,
    Footage,
    MonitoredKeypoints,
    MonitoredSegmenter,
    TrueKeypoints,
    TrueSegmenter,
    assert_same_tracking,
)
from support.worker_tasks import quick_fit

from jaxfit.cli.main import main
from jaxfit.config.perception import FramesConfig, SegmenterConfig, TrackConfig, TrackerConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster, open_cluster
from jaxfit.model.files import load_murre, save_bird
from jaxfit.perception import detections, track, worker_tasks
from jaxfit.perception.carried_masks import BLOCK_FRAMES
from jaxfit.perception.track import run_tracking
from jaxfit.perception.tracking import load_tracker
from jaxfit.simulation.scene import simulate

pytest.importorskip("distributed")
FOOTAGE = Footage()
CONFIG = TrackConfig(min_track_frames=2)
WHOLE_TASK_FRAMES = worker_tasks.FRAMES_PER_TASK  # before the fixture makes tasks small


def networks():
    return MonitoredSegmenter(FOOTAGE, MISSED), MonitoredKeypoints(FOOTAGE)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    folder = FOOTAGE.write(tmp_path_factory.mktemp("toy") / "frames")
    for damaged in (2, 3, 6, 11):
        (folder / f"{damaged}.png").write_bytes(b"damaged")
    return folder


@pytest.fixture(autouse=True)
def _toy_networks(monkeypatch):
    """Small tasks and parts; the workers of this process open toy networks."""
    monkeypatch.setattr(worker_tasks, "FRAMES_PER_TASK", 3)
    monkeypatch.setattr(detections, "FRAMES_PER_PART", 4)
    monkeypatch.setattr(worker_tasks, "open_segmenter", lambda _: networks()[0])
    monkeypatch.setattr(worker_tasks, "open_keypoint_detector", lambda _: networks()[1])
    worker_tasks._networks.cache_clear()


@pytest.mark.parametrize("frames", [FramesConfig(), FramesConfig(1, 9, 1), FramesConfig(0, None, 2)])
def test_tracks_are_those_of_one_process(video, workers, frames, tmp_path):
    config, stored = dataclasses.replace(CONFIG, frames=frames), (tmp_path / "a", tmp_path / "b")
    alone = run_tracking(video, config, *networks(), parts=Parts(stored[0], {}))
    together = run_tracking(video, config, *networks(), parts=Parts(stored[1], {}), cluster=workers)
    assert_same_tracking(together, alone)
    assert [n in together.damaged_frames for n in (2, 6)] == [True, True]
    for file in sorted(stored[0].glob("*.npz")):
        one, other = np.load(file), np.load(stored[1] / file.name)
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_shipped_tasks_hold_whole_blocks():
    assert WHOLE_TASK_FRAMES % BLOCK_FRAMES == 0


def test_tasks_hold_whole_blocks(video, workers, monkeypatch):
    monkeypatch.setattr(detections, "BLOCK_FRAMES", 3)
    monkeypatch.setattr(worker_tasks, "FRAMES_PER_TASK", 6)
    monkeypatch.setattr(worker_tasks, "open_segmenter", lambda _: BlockSegmenter(FOOTAGE))
    alone = run_tracking(video, CONFIG, BlockSegmenter(FOOTAGE), networks()[1])
    assert_same_tracking(run_tracking(video, CONFIG, BlockSegmenter(FOOTAGE), networks()[1], cluster=workers), alone)


def test_an_interrupted_tracking_continues(video, workers, tmp_path):
    whole = run_tracking(video, CONFIG, *networks())
    run_tracking(video, CONFIG, *networks(), parts=Parts(tmp_path / "p", {}), cluster=workers)
    parts = Parts(tmp_path / "p", {})
    parts.keep(1)
    assert_same_tracking(run_tracking(video, CONFIG, *networks(), parts=parts, cluster=workers), whole)


def test_results_that_arrive_in_another_order(video, workers):
    class Shuffled(Cluster):
        def run(self, *given):
            return reversed(list(workers.run(*given)))

    assert_same_tracking(
        run_tracking(video, CONFIG, *networks(), cluster=Shuffled(lambda: None, "")),
        run_tracking(video, CONFIG, *networks()),
    )


def test_a_task_that_fails_costs_its_frames(video, workers, monkeypatch, caplog):
    def read(path, start, *more):
        if start == 6:
            raise RuntimeError("no memory")
        return read_frames(path, start, *more)

    read_frames = worker_tasks.read_frames
    monkeypatch.setattr(worker_tasks, "read_frames", read)
    tracking = run_tracking(video, CONFIG, *networks(), cluster=workers)
    assert tracking.damaged_frames == [2, 3, 6, 7, 8, 11]
    assert tracking.observations.frame_index.tolist() == [0, 1, 4, 5, 9, 10]
    assert "no detections: failed 3 times on the workers: RuntimeError: no memory" in caplog.text


def test_files_that_a_worker_cannot_use(video, workers, tmp_path):
    """Another size than in the command, and a network that is not there."""
    absent = tmp_path / "absent.onnx"
    shared = worker_tasks.shared_data(video, CONFIG)
    other = shared._replace(sizes=(7, *shared.sizes[1:]))
    with pytest.raises(InputError, match=rf"worker on .*: {video}: differs from the file of the command"):
        worker_tasks.detect_range(other, range(2))
    missing = dataclasses.replace(CONFIG, segmenter=SegmenterConfig(str(absent)))
    with pytest.raises(InputError, match=r"absent\.onnx: cannot be read: No such file"):
        worker_tasks.detect_on_workers(workers, video, missing, range(FRAMES), track.Clock())
    with pytest.raises(InputError, match=r"worker on .*absent\.onnx: cannot be read: No such file"):
        worker_tasks.detect_range(shared._replace(config=missing), range(2))


def test_a_changed_network_is_loaded_again(video, tmp_path, monkeypatch):
    """Workers of a cluster live long, and a training may write a network of the same name."""
    opened, file = [], tmp_path / "n.onnx"
    monkeypatch.setattr(worker_tasks, "network_files", lambda _: {"segmenter": [file]})
    monkeypatch.setattr(worker_tasks, "open_segmenter", lambda config: opened.append(config) or networks()[0])
    for content in (b"1", b"1", b"22"):
        if not file.exists() or file.read_bytes() != content:
            file.write_bytes(content)
        assert len(worker_tasks.detect_range(worker_tasks.shared_data(video, CONFIG), range(2))) == 2
    assert len(opened) == 2


@pytest.mark.parametrize("reason", ["uses the pictures", "does not contain the number"])
def test_networks_that_run_in_this_process(video, workers, monkeypatch, caplog, reason):
    tracker = load_tracker("iou")
    tracker.uses_pictures = "pictures" in reason
    if "number" in reason:
        monkeypatch.setattr(track, "expected_frames", lambda *_: None)
    used = []
    monkeypatch.setattr(track, "detect", lambda *given: used.append(1) or detections.detect(*given))
    run_tracking(video, CONFIG, *networks(), tracker, cluster=workers)
    assert used
    assert reason in caplog.text


def test_the_commands(video, scheduler, tmp_path, monkeypatch):
    """The files of tracking and of a reconstruction on workers are those of one process."""
    monkeypatch.setattr("jaxfit.fitting.tasks.fit_task", quick_fit)
    FOOTAGE.write(tmp_path / "frames")
    save_bird(BIRD, tmp_path / "toy.npz")
    (tmp_path / "quick.yaml").write_text(CONFIG_OF_A_COMMAND + "overlay: {write: false}\n")
    with toy_networks(TrueSegmenter(FOOTAGE)):
        monkeypatch.setattr(worker_tasks, "open_segmenter", lambda _: TrueSegmenter(FOOTAGE))
        monkeypatch.setattr(worker_tasks, "open_keypoint_detector", lambda _: TrueKeypoints(FOOTAGE))
        monkeypatch.setattr(worker_tasks, "network_files", lambda _: {})
        assert main(command(tmp_path, out="alone")) == 0
        assert main(command(tmp_path, "--scheduler", scheduler)) == 0
        assert contents(tmp_path / "result") == contents(tmp_path / "alone")
        track = ["track", str(tmp_path / "frames"), "--config", str(tmp_path / "quick.yaml"), "--out"]
        assert main([*track, str(tmp_path / "alone.json")]) == 0
        assert main([*track, str(tmp_path / "workers.json"), "--scheduler", scheduler]) == 0
    assert (tmp_path / "workers.json").read_bytes() == (tmp_path / "alone.json").read_bytes()


@pytest.mark.extended
def test_built_in_networks_in_two_processes(tmp_path, monkeypatch):
    """The results do not depend on the number of processes."""
    monkeypatch.undo()
    simulate(load_murre(), tmp_path / "scene", birds=2, frames=30, size=(640, 380))
    video, config = tmp_path / "scene" / "footage.mp4", TrackConfig(tracker=TrackerConfig("iou"))
    alone = run_tracking(video, config)
    with open_cluster(workers=2) as cluster:
        assert_same_tracking(run_tracking(video, config, cluster=cluster), alone)
    assert alone.observations.num_tracks
