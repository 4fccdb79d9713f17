"""Frames as parts: what is stored is what is read, and a tracker continues."""

import numpy as np
import pytest
from support.toy_footage import (
    FRAMES,
    MISSED,
    BlockSegmenter,
    Footage,
    MonitoredSegmenter,
    TrueKeypoints,
    assert_same_tracking,
)

from jaxfit.config.perception import FramesConfig, TrackConfig, TrackerConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts
from jaxfit.perception import detections, track
from jaxfit.perception.track import run_tracking
from jaxfit.perception.tracking import load_tracker

FOOTAGE = Footage()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    folder = FOOTAGE.write(tmp_path_factory.mktemp("toy") / "frames")
    (folder / "6.png").write_bytes(b"damaged")
    return folder


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(detections, "FRAMES_PER_PART", 4)


class StoppedError(Exception):
    pass


class Stopping(MonitoredSegmenter):
    """Stops before a frame."""

    def __init__(self, stop=None):
        super().__init__(FOOTAGE, MISSED)
        self.stop = stop

    def __call__(self, frame):
        if int(frame[0, 0, 0]) == self.stop:
            raise StoppedError
        return super().__call__(frame)


def run(video, parts=None, stop=None, **settings):
    config = TrackConfig(min_track_frames=2, **settings)
    segmenter = Stopping(stop)
    return run_tracking(video, config, segmenter, TrueKeypoints(FOOTAGE), parts=parts), segmenter.frames


@pytest.mark.parametrize("frames", [FramesConfig(), FramesConfig(1, 9, 1), FramesConfig(0, None, 2)])
def test_a_tracking_that_stops_at_every_frame(video, tmp_path, frames):
    whole, all_frames = run(video, frames=frames)
    assert whole.damaged_frames == ([6] if 6 in range(FRAMES)[frames.start : frames.stop : frames.step] else [])
    done = []
    for stop in all_frames[1:]:
        with pytest.raises(StoppedError):
            run(video, Parts(tmp_path / "p", {}), stop, frames=frames)
    parts = Parts(tmp_path / "p", {})
    assert parts.numbers == list(range((len(all_frames) - 1) // 4))
    resumed, done = run(video, parts, frames=frames)
    assert done == all_frames[4 * ((len(all_frames) - 1) // 4) :]
    assert_same_tracking(resumed, whole)
    again, done = run(video, Parts(tmp_path / "p", {}), frames=frames)
    assert done == []
    assert_same_tracking(again, whole)


@pytest.mark.parametrize("frames", [FramesConfig(), FramesConfig(1, 9, 1), FramesConfig(0, None, 2)])
def test_parts_end_with_blocks_so_a_tracking_that_continues_has_the_same_blocks(video, tmp_path, monkeypatch, frames):
    monkeypatch.setattr(detections, "BLOCK_FRAMES", 3)
    config = TrackConfig(min_track_frames=2, frames=frames)

    def track(parts=None):
        segmenter = BlockSegmenter(FOOTAGE)
        return run_tracking(video, config, segmenter, TrueKeypoints(FOOTAGE), parts=parts), segmenter.frames

    whole, seen = track(Parts(tmp_path / "p", {}))
    assert len(set(np.asarray(whole.observations.score)[whole.observations.present])) == 3
    numbers = Parts(tmp_path / "p", {}).numbers
    for kept in numbers:
        parts = Parts(tmp_path / "p", {})
        parts.keep(kept)
        resumed, seen_again = track(parts)
        assert_same_tracking(resumed, whole)
        assert len(seen_again) < len(seen) or kept == 0


@pytest.mark.parametrize("block_frames", [1, 2])
def test_a_block_of_damaged_frames_is_not_segmented(video, monkeypatch, block_frames):
    monkeypatch.setattr(detections, "BLOCK_FRAMES", block_frames)
    blocks = []

    class Recording(BlockSegmenter):
        def segment_block(self, frames):
            blocks.append(len(frames))
            return super().segment_block(frames)

    result = run_tracking(video, TrackConfig(frames=FramesConfig(0, 7)), Recording(FOOTAGE), TrueKeypoints(FOOTAGE))
    assert result.damaged_frames == [6]
    assert blocks == [block_frames] * (6 // block_frames)


def test_a_missing_part_and_a_damaged_part(video, tmp_path):
    whole, _ = run(video, Parts(tmp_path / "p", {}))
    file = tmp_path / "p" / "000001.npz"
    content = file.read_bytes()
    file.write_bytes(content[:-9])
    with pytest.raises(InputError, match=r"000001\.npz: is not an \.npz file .*remove this file"):
        run(video, Parts(tmp_path / "p", {}))
    file.unlink()
    resumed, done = run(video, Parts(tmp_path / "p", {}))
    assert done == [4, 5, 7, 8, 9, 10, 11]
    assert_same_tracking(resumed, whole)


def test_numbers_of_birds_that_do_not_agree(video, tmp_path):
    run(video, Parts(tmp_path / "p", {}))
    path = tmp_path / "p" / "000000.npz"
    arrays = dict(np.load(path))
    arrays["birds"] = arrays["birds"] + 1
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=r"000000\.npz: holds frames whose numbers of birds do not agree"):
        run(video, Parts(tmp_path / "p", {}))


@pytest.mark.parametrize("uses_pictures", [True, False])
def test_a_tracker_that_cannot_continue_begins_again(video, tmp_path, monkeypatch, caplog, uses_pictures):
    """A tracker needs pictures, or gives other identities than before."""
    made = []

    def load(*_, **__):
        made.append(load_tracker("iou"))
        made[-1].uses_pictures = uses_pictures
        made[-1]._next_identity = 1 if uses_pictures else len(made)
        return made[-1]

    monkeypatch.setattr(track, "load_tracker", load)
    with pytest.raises(StoppedError):
        run(video, Parts(tmp_path / "p", {}), 9, tracker=TrackerConfig("iou"))
    resumed, done = run(video, Parts(tmp_path / "p", {}), tracker=TrackerConfig("iou"))
    assert done[0] == 0
    assert "tracking begins again" in caplog.text
    assert resumed.observations.num_frames == FRAMES - 1
