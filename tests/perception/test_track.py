"""From frames to observations, with stand-ins for the networks: what is found is what was there."""

import logging

import cv2
import numpy as np
import pytest
from support.toy_footage import BIRD, BIRDS, FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.config.perception import FramesConfig, SegmenterConfig, TrackConfig, TrackerConfig
from jaxfit.errors import InputError
from jaxfit.perception import track
from jaxfit.perception.track import find_tracks, open_segmenter, track_video

FOOTAGE = Footage()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return FOOTAGE.write(tmp_path_factory.mktemp("toy") / "frames")


def followed(video, config=TrackConfig(min_track_frames=2), missed=(), **more):
    segmenter, keypoints = TrueSegmenter(FOOTAGE, missed), TrueKeypoints(FOOTAGE)
    return find_tracks(video, config, segmenter, keypoints, **more), segmenter, keypoints


def columns(observations):
    """Which true bird each track is, by where its first keypoint is seen."""
    at = observations.present.argmax(1)
    return [int(observations.keypoints_px[n, at[n], 0, 0] // SIDE) for n in range(observations.num_tracks)]


def test_what_is_found_is_what_was_there(video):
    found = track_video(video, TrackConfig(), TrueSegmenter(FOOTAGE), TrueKeypoints(FOOTAGE))
    assert found.frame_index.tolist() == list(range(FRAMES))
    assert found.present.all()
    order = columns(found)
    assert sorted(order) == [0, 1, 2]
    np.testing.assert_array_equal(found.keypoints_px, np.moveaxis(FOOTAGE.keypoints_px, 1, 0)[order].astype(np.float32))
    assert (found.confidence == np.float32(0.8)).all()
    assert found.keypoint_names == BIRD.keypoint_names
    assert (found.image_size_px == [BIRDS * SIDE, SIDE]).all()
    assert found.file_name[3] == "frames#3"
    for n, column in enumerate(order):
        whole = np.zeros((SIDE, BIRDS * SIDE), bool)
        whole[:, SIDE * column : SIDE * (column + 1)] = FOOTAGE.masks[5][column]
        np.testing.assert_array_equal(found.mask(n, 5), whole)
        assert found.score[n, 5] == pytest.approx(0.9 - 0.1 * column)


def test_a_range_of_frames(video):
    config = TrackConfig(FramesConfig(2, 11, 3), min_track_frames=2)
    tracking, segmenter, _ = followed(video, config)
    assert tracking.observations.frame_index.tolist() == [2, 5, 8]
    assert segmenter.seen == [2, 5, 8]
    assert tracking.observations.present.all()


def test_a_bird_missed_for_a_while_stays_the_same(video):
    missed = [(t, 1) for t in range(4, 9)]
    tracking, _, keypoints = followed(video, missed=missed)
    found = tracking.observations
    n = columns(found).index(1)
    assert np.flatnonzero(~found.present[n]).tolist() == [4, 5, 6, 7, 8]
    assert found.present.sum() == FRAMES * BIRDS - 5
    assert keypoints.asked == [2 if 4 <= t < 9 else 3 for t in range(FRAMES)]


def test_short_tracks_are_left_out_and_told(video):
    missed = [(t, 2) for t in range(FRAMES) if t not in (3, 4)]
    tracking, _, _ = followed(video, TrackConfig(min_track_frames=3), missed)
    assert tracking.observations.num_tracks == 2
    assert list(tracking.short.values()) == [2]
    assert not set(tracking.short) & set(tracking.observations.track_id.tolist())
    assert tracking.nothing is None


def test_birds_that_are_not_tracked_are_not_looked_at(video):
    class Choosy:
        def update(self, frame_index, instances, frame=None):
            return [7 if bird.x0 >= 2 * SIDE else None for bird in instances]

    tracking, _, keypoints = followed(video, tracker=Choosy())
    assert tracking.observations.track_id.tolist() == [7]
    assert columns(tracking.observations) == [2]
    assert keypoints.asked == [1] * FRAMES


def test_swaps_are_repaired_if_asked(video):
    pairs = BIRD.keypoint_pairs

    class Mixed(TrueKeypoints):
        def __call__(self, frame, instances):
            points, confidence = super().__call__(frame, instances)
            if frame[0, 0, 0] == 6:
                for left, right in pairs:
                    points[:, [left, right]] = points[:, [right, left]]
            return points, confidence

    def run(repair):
        config = TrackConfig(repair_left_right_flips=repair)
        return track_video(video, config, TrueSegmenter(FOOTAGE), Mixed(FOOTAGE)).keypoints_px

    truth = track_video(video, TrackConfig(), TrueSegmenter(FOOTAGE), TrueKeypoints(FOOTAGE)).keypoints_px
    assert (run(False)[:, 6] != truth[:, 6]).any()
    np.testing.assert_array_equal(run(True), truth)


def test_progress_tells_speed_and_birds(video):
    told = []

    class Task:
        def __init__(self, name, total):
            told.append((name, total))

        def __enter__(self):
            return lambda done, note: told.append((done, note))

        def __exit__(self, *error):
            return None

    followed(video, missed=[(11, 0), (11, 1)], progress=Task)
    assert told[0] == ("Tracking", FRAMES)
    assert [done for done, _ in told[1:]] == [1] * FRAMES
    assert told[1][1].endswith("frames/s, 3 birds")
    assert told[-1][1].endswith(" 1 bird")


def test_every_part_has_its_time(video):
    tracking, _, _ = followed(video)
    assert set(tracking.seconds) == {"decode", "segment", "track", "keypoints", "record", "clean up"}


def test_opencv_has_its_threads_back(video):
    before, during = cv2.getNumThreads(), []

    class Watching(TrueSegmenter):
        def __call__(self, frame):
            during.append(cv2.getNumThreads())
            raise InputError("stop", "here")

    cv2.setNumThreads(2)
    try:
        with pytest.raises(InputError, match="stop"):
            find_tracks(video, TrackConfig(), Watching(FOOTAGE), TrueKeypoints(FOOTAGE))
        assert (during, cv2.getNumThreads()) == ([1], 2)
    finally:
        cv2.setNumThreads(before)


EVERYONE = [(t, n) for t in range(FRAMES) for n in range(BIRDS)]


def test_no_bird_in_the_whole_video(video, monkeypatch, caplog):
    """The config's own segmenter is asked again, for anything it hardly trusts."""
    opened = []

    def open_one(config, min_score=None):
        opened.append(min_score)
        return TrueSegmenter(FOOTAGE, EVERYONE if min_score is None else EVERYONE[:-1])

    monkeypatch.setattr(track, "open_segmenter", open_one)
    config = TrackConfig(segmenter=SegmenterConfig(classes=("duck", "goose"), min_score=0.95))
    with caplog.at_level(logging.WARNING):
        found = track_video(video, config, keypoints=TrueKeypoints(FOOTAGE))
    assert (found.num_tracks, found.num_frames) == (0, FRAMES)
    assert opened == [None, track.FAINT]
    (message,) = caplog.messages
    assert message.startswith(f"{video}: no duck or goose was found in 12 frames with a score of 0.95 or more")
    assert "; nothing has even a score of 0.05 (" in message  # the last frame is none of those looked at again
    monkeypatch.setattr(track, "LOOKS", 12)
    nothing = find_tracks(video, config, keypoints=TrueKeypoints(FOOTAGE)).nothing
    assert "the highest score seen is 0.70" in str(nothing)
    assert "min_score" in nothing.remedy


def test_no_bird_by_a_segmenter_of_ones_own(video):
    nothing = followed(video, missed=EVERYONE)[0].nothing
    assert "no bird was found in 12 frames" in str(nothing)
    assert "score seen" not in str(nothing)


def test_only_birds_that_are_seen_too_briefly(video):
    tracking, _, _ = followed(video, TrackConfig(min_track_frames=FRAMES + 1))
    assert tracking.observations.num_tracks == 0
    assert "for 13 frames: of 3 that were seen, with scores up to 0.90, none was in more than 12" in str(
        tracking.nothing
    )
    assert "min_track_frames" in tracking.nothing.remedy


def test_a_range_beyond_the_end(video):
    with pytest.raises(InputError, match=r"frames: has no frame from 12 on"):
        followed(video, TrackConfig(FramesConfig(12)))


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (TrackConfig(segmenter=SegmenterConfig(file="none.onnx")), "none.onnx: does not exist"),
        (TrackConfig(segmenter=SegmenterConfig(kind="magic")), "'magic' .one of auto, "),
    ],
)
def test_networks_that_cannot_be_opened(config, words):
    with pytest.raises(InputError, match=words):
        open_segmenter(config)


def test_an_unknown_tracker(video):
    with pytest.raises(InputError, match=r"tracker hungarian.*iou"):
        followed(video, TrackConfig(tracker=TrackerConfig("hungarian")))
