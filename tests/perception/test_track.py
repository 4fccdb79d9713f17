"""Tracking of a video with networks that report the truth."""

import logging
import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.toy_footage import BIRD, BIRDS, FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.config.perception import FramesConfig, KeypointsConfig, SegmenterConfig, TrackConfig, TrackerConfig
from jaxfit.data.observations import FROM_OUTLINE
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.threads import in_threads
from jaxfit.model.anatomy import AVES_KEYPOINTS
from jaxfit.perception import track
from jaxfit.perception.network import OUTPUT, ActivationMonitor, ActivationStatistics
from jaxfit.perception.track import open_segmenter, run_tracking, track_video
from jaxfit.video.writer import VideoWriter

FOOTAGE = Footage()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return FOOTAGE.write(tmp_path_factory.mktemp("toy") / "frames")


def tracked(video, config=TrackConfig(min_track_frames=2), missed=(), **more):
    segmenter, keypoints = TrueSegmenter(FOOTAGE, missed), TrueKeypoints(FOOTAGE)
    return run_tracking(video, config, segmenter, keypoints, **more), segmenter, keypoints


def columns(observations):
    """The true bird of each track, by the position of its first keypoint."""
    at = observations.present.argmax(1)
    return [int(observations.keypoints_px[n, at[n], 0, 0] // SIDE) for n in range(observations.num_tracks)]


def test_tracks_are_the_truth(video):
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


def test_keypoints_of_outlines_say_so(video):
    config = TrackConfig(keypoints=KeypointsConfig(file="outline"), min_track_frames=2)
    tracking = run_tracking(video, config, TrueSegmenter(FOOTAGE))
    found = tracking.observations
    assert tracking.trust.signals.confidence is None
    assert found.keypoint_names == AVES_KEYPOINTS
    assert (found.keypoint_origin == FROM_OUTLINE).all()


def test_a_range_of_frames(video):
    config = TrackConfig(FramesConfig(2, 11, 3), min_track_frames=2)
    tracking, segmenter, _ = tracked(video, config)
    assert tracking.observations.frame_index.tolist() == [2, 5, 8]
    assert segmenter.frames == [2, 5, 8]
    assert tracking.observations.present.all()


def test_times_of_the_frames(video, tmp_path):
    """Tracks hold the times and the rate of a film; a folder of pictures has neither."""
    with VideoWriter(tmp_path / "film.mp4", (BIRDS * SIDE, SIDE), 12.5) as writer:
        for t in range(FRAMES):
            writer.write(FOOTAGE.frame(t))
    found = tracked(tmp_path / "film.mp4", TrackConfig(FramesConfig(2, 11, 3), min_track_frames=2))[0].observations
    assert found.fps == 12.5
    np.testing.assert_allclose(found.timestamp_s, [2 / 12.5, 5 / 12.5, 8 / 12.5])
    pictures = tracked(video)[0].observations
    assert pictures.fps is None
    assert np.isnan(pictures.timestamp_s).all()


def test_missed_bird_keeps_its_identity(video):
    missed = [(t, 1) for t in range(4, 9)]
    tracking, _, keypoints = tracked(video, missed=missed)
    found = tracking.observations
    n = columns(found).index(1)
    assert np.flatnonzero(~found.present[n]).tolist() == [4, 5, 6, 7, 8]
    assert found.present.sum() == FRAMES * BIRDS - 5
    assert keypoints.counts == [2 if 4 <= t < 9 else 3 for t in range(FRAMES)]


def test_short_tracks_are_excluded_and_reported(video):
    missed = [(t, 2) for t in range(FRAMES) if t not in (3, 6)]  # only its detections count
    tracking, _, _ = tracked(video, TrackConfig(min_track_frames=3), missed)
    assert tracking.observations.num_tracks == 2
    assert list(tracking.short_tracks.values()) == [2]
    assert not set(tracking.short_tracks) & set(tracking.observations.track_id.tolist())
    assert tracking.failure is None


def test_tracks_with_low_scores_are_excluded_and_reported(video):
    """The birds have scores of 0.9, 0.8 and 0.7; the network asks for 0.75, and a config asks for other values."""

    class Scored(TrueSegmenter):
        min_track_score = 0.75

    def run(**settings):
        segmenter = Scored(FOOTAGE, [(4, 0), (4, 2)])  # only frames with a detection count for the mean
        return run_tracking(video, TrackConfig(min_track_frames=2, **settings), segmenter, TrueKeypoints(FOOTAGE))

    tracking = run()
    assert sorted(columns(tracking.observations)) == [0, 1]
    assert list(tracking.low_score_tracks.values()) == pytest.approx([0.7])
    assert not set(tracking.low_score_tracks) & set(tracking.observations.track_id.tolist())
    assert not tracking.short_tracks
    assert tracking.trust.signals.tracks == BIRDS  # the trust judges all tracks
    assert run(min_track_score=0.0).observations.num_tracks == BIRDS
    failure = run(min_track_score=0.95).failure
    assert "no tracked bird has a mean score of 0.95: the highest of 3 tracks is 0.900" in str(failure)


def test_birds_without_a_track_are_neighbours_in_crops_only(video):
    class OneBird:
        def update(self, frame_index, instances, frame=None):
            return [7 if bird.x0 >= 2 * SIDE else None for bird in instances]

    tracking, _, keypoints = tracked(video, tracker=OneBird())
    assert tracking.observations.track_id.tolist() == [7]
    assert columns(tracking.observations) == [2]
    assert keypoints.counts == [3] * FRAMES


def test_progress_reports_speed_and_birds(video):
    reports = []

    class Task:
        def __init__(self, name, total):
            reports.append((name, total))

        def __enter__(self):
            return lambda done, note: reports.append((done, note))

        def __exit__(self, *error):
            return None

    tracked(video, missed=[(11, 0), (11, 1)], progress=Task)
    assert reports[0] == ("Tracking", FRAMES)
    assert [done for done, _ in reports[1:]] == [1] * FRAMES
    assert reports[1][1].endswith("frames/s, 3 birds now")
    assert reports[-1][1].endswith(" 1 bird now")


def test_durations_of_all_parts(video):
    tracking, _, _ = tracked(video)
    assert set(tracking.seconds) == {"detect", "track", "record", "clean up"}


def test_the_segmenter_runs_a_few_frames_ahead(video):
    """The memory is bounded, however long the keypoints take."""
    segmenter, ahead = TrueSegmenter(FOOTAGE), []

    class Counting(TrueKeypoints):
        def __call__(self, frame, instances):
            ahead.append(len(segmenter.frames) - len(ahead))
            return super().__call__(frame, instances)

    run_tracking(video, TrackConfig(min_track_frames=2), segmenter, Counting(FOOTAGE))
    assert segmenter.frames == list(range(FRAMES))
    assert max(ahead) <= 3


def test_several_frames_at_once():
    """Their results come in order, at most so many are computed at once, and each thread has its own distances."""
    count, running, most, together = 3, [], [], threading.Barrier(3, timeout=60)
    monitor = ActivationMonitor(
        SimpleNamespace(check_outputs=lambda *_: None), ActivationStatistics(np.zeros(1), np.eye(1))
    )

    def compute(n):
        running.append(n)
        monitor.add({OUTPUT: np.full((1, 1), n)}, 1)
        together.wait()  # ends only if three threads are here
        most.append(len(running))
        running.remove(n)
        return n, monitor.take().tolist()

    assert list(in_threads(compute, range(4 * count), count)) == [(n, [n]) for n in range(4 * count)]
    assert max(most) == count


def test_an_error_in_the_thread_of_the_segmenter(video):
    """The error arrives after the frames before it, and the threads end."""

    class Failing(TrueSegmenter):
        def __call__(self, frame):
            if int(frame[0, 0, 0]) == 5:
                raise InputError("net.onnx", "cannot be run", "check the layout of its inputs")
            return super().__call__(frame)

    keypoints = TrueKeypoints(FOOTAGE)
    with pytest.raises(InputError, match=r"net\.onnx: cannot be run \(check the layout of its inputs\)"):
        run_tracking(video, TrackConfig(min_track_frames=2), Failing(FOOTAGE), keypoints)
    assert len(keypoints.counts) == 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("ahead", "detect"))]


def test_number_of_opencv_threads_is_restored(video):
    before, during = cv2.getNumThreads(), []

    class Watching(TrueSegmenter):
        def __call__(self, frame):
            during.append(cv2.getNumThreads())
            raise InputError("stop", "here")

    cv2.setNumThreads(2)
    try:
        with pytest.raises(InputError, match="stop"):
            run_tracking(video, TrackConfig(), Watching(FOOTAGE), TrueKeypoints(FOOTAGE))
        assert (during, cv2.getNumThreads()) == ([1], 2)
    finally:
        cv2.setNumThreads(before)


ALL_BIRDS = [(t, n) for t in range(FRAMES) for n in range(BIRDS)]


def test_no_bird_in_the_video(video, monkeypatch, caplog):
    """The segmenter of the config runs again with a low score."""
    opened = []

    def open_one(config, min_score=None):
        opened.append(min_score)
        return TrueSegmenter(FOOTAGE, ALL_BIRDS if min_score is None else ALL_BIRDS[:-1])

    monkeypatch.setattr(track, "open_segmenter", open_one)
    config = TrackConfig(segmenter=SegmenterConfig("general", classes=("duck", "goose"), min_score=0.95))
    with caplog.at_level(logging.WARNING):
        found = track_video(video, config, keypoints=TrueKeypoints(FOOTAGE))
    assert (found.num_tracks, found.num_frames) == (0, FRAMES)
    assert opened == [None, track.RETRY_MIN_SCORE]
    (message,) = caplog.messages
    assert message.startswith(f"{video}: no duck or goose was detected in 12 frames with a score of 0.95 or more")
    assert "; no score reaches 0.05 (" in message  # the last frame is not segmented again
    monkeypatch.setattr(track, "RETRY_FRAMES", 12)
    failure = run_tracking(video, config, keypoints=TrueKeypoints(FOOTAGE)).failure
    assert "the highest score is 0.70" in str(failure)
    assert "--min-score" in failure.remedy


def test_no_bird_with_a_segmenter_of_the_caller(video):
    failure = tracked(video, missed=ALL_BIRDS)[0].failure
    assert "no bird was detected in 12 frames" in str(failure)
    assert "highest score" not in str(failure)


def test_only_short_tracks(video):
    tracking, _, _ = tracked(video, TrackConfig(min_track_frames=FRAMES + 1))
    assert tracking.observations.num_tracks == 0
    assert "for 13 frames: there are 3 shorter tracks, with scores up to 0.90 and at most 12 frames" in str(
        tracking.failure
    )
    assert "--min-track-frames" in tracking.failure.remedy


def test_range_beyond_the_end(video):
    with pytest.raises(InputError, match=r"frames: has no frame from 12 on"):
        tracked(video, TrackConfig(FramesConfig(12)))


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
        tracked(video, TrackConfig(tracker=TrackerConfig("hungarian")))


class Monitor:
    """Reports one distance for each call of the network since the last question."""

    def __init__(self):
        self.distances = [99.0]  # of an earlier video

    def take(self):
        taken, self.distances = np.array(self.distances), []
        return taken


def test_trust_uses_the_distances_of_this_video(video):
    class Near(TrueSegmenter):
        activations = Monitor()

        def __call__(self, frame):
            self.activations.distances.append(0.25)
            return super().__call__(frame)

    class Distant(TrueKeypoints):
        activations = Monitor()

        def __call__(self, frame, instances):
            self.activations.distances += [7.0] * len(instances)
            return super().__call__(frame, instances)

    judged = run_tracking(video, TrackConfig(min_track_frames=2), Near(FOOTAGE), Distant(FOOTAGE)).trust
    assert (judged.signals.frame_distance, judged.signals.bird_distance) == (0.25, 7.0)
    assert judged.level == "low"
    assert any("keypoint network" in reason for reason in judged.reasons)


def test_trust_without_statistics_or_birds(video):
    tracking, _, _ = tracked(video)
    assert tracking.trust.level == "high"
    nothing, _, _ = tracked(video, missed=[(t, n) for t in range(FRAMES) for n in range(BIRDS)])
    assert nothing.trust.reasons == ("no bird was tracked",)
