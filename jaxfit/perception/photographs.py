"""`track_photographs`: the bird of every picture of a folder, and its keypoints."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path

import numpy as np

from jaxfit.config.perception import TrackConfig
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import Clock, ProgressTask, silent
from jaxfit.foundation.threads import in_threads
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.perception.detections import (
    frames_at_once,
    open_keypoint_detector,
    open_segmenter,
    single_opencv_thread,
    take_distances,
)
from jaxfit.perception.segmenter_choice import FRAMES, with_chosen_segmenter
from jaxfit.perception.track import TrackingResult
from jaxfit.perception.tracking import RecordedFrame, all_distances, record_frame
from jaxfit.perception.trust import footage_signals, judge
from jaxfit.video.pictures import image_files, read_picture

_logger = logging.getLogger(__name__)


def track_photographs(
    folder: str | Path, config: TrackConfig = TrackConfig(), progress: ProgressTask = silent
) -> TrackingResult:
    """Detect the birds of photographs, one by one, and their keypoints.

    General segmenters search more thoroughly than in a film (`DetectorAndSaliency.photograph`). Pictures may have
    several sizes. Settings of tracks are not used.

    Args:
        folder: a folder of pictures.
        config: the pictures, as frames, and the networks.
        progress: reports every picture.

    Returns:
        The observations, in which every bird is frame 0 of its picture; `damaged_frames` are the numbers of pictures
        that cannot be read.

    Raises:
        InputError: the folder cannot be read or has no pictures, or a network cannot be used.
    """
    if not Path(folder).is_dir():
        raise InputError(folder, "is no folder", "give a folder of pictures, or leave out --photographs for a film")
    frames = config.frames
    files = dict(list(enumerate(image_files(Path(folder))))[frames.start : frames.stop : frames.step])
    if not files:
        raise InputError(folder, f"has no picture from {frames.start} on", "begin with an earlier picture")
    some = np.unique(np.linspace(0, len(files) - 1, FRAMES).astype(int))
    examples = [picture for i in some if (picture := read_picture(list(files.values())[i])) is not None]
    config, choice = with_chosen_segmenter(folder, config, progress, examples)
    segmenter, keypoints, clock = open_segmenter(config), open_keypoint_detector(config), Clock()
    segment = getattr(segmenter, "photograph", segmenter)
    records: list[RecordedFrame] = []
    damaged = []

    def record(item: tuple[int, Path]) -> RecordedFrame | int:
        number, file = item
        picture = read_picture(file)
        if picture is None:
            return number
        birds = segment(picture)
        positions_px, confidence = keypoints(picture, birds)
        size_px, identities = (picture.shape[1], picture.shape[0]), list(range(1, len(birds) + 1))
        distances = take_distances(segmenter), take_distances(keypoints)
        return record_frame(
            number, file.name, size_px, birds, identities, positions_px, confidence, distances=distances
        )

    with (
        single_opencv_thread(),
        progress("Photographs", len(files)) as report_progress,
        closing(in_threads(record, files.items(), frames_at_once(config))) as results,
    ):
        for item in clock.each("detect", results):
            if isinstance(item, int):
                damaged.append(item)
                continue
            records.append(item)
            report_progress(1, f"{item.file_name}, {counted(len(item.score), 'bird')}")
    empty = [record.file_name for record in records if not len(record.score)]
    if empty:
        _logger.warning("no bird in %s", ", ".join([*empty[:10], *(["…"] if len(empty) > 10 else [])]))
    observations = _observations(records, keypoints.keypoint_names)
    signals = footage_signals(observations, {}, all_distances(records), getattr(keypoints, "curve", None) is not None)
    failure = None
    if not observations.num_tracks:
        remedy = "use another --segmenter (`jaxfit networks get general` for birds of any species), or draw masks"
        failure = InputError(folder, f"no bird was detected in {counted(len(records), 'picture')}", remedy)
    return TrackingResult(observations, {}, {}, damaged, failure, judge(signals), choice, clock.seconds)


def _observations(records: list[RecordedFrame], names: tuple[str, ...]) -> Observations:
    """Return photographs as observations: every bird is a track of one frame, with an image of its own."""
    birds = [(record, m) for record in records for m in range(len(record.score))]
    N, K = len(birds), len(names)

    def of_birds(name: str, *shape: int) -> np.ndarray:
        return np.array([getattr(record, name)[m] for record, m in birds], np.float32).reshape(N, 1, *shape)

    return Observations(
        track_id=np.arange(1, N + 1),
        frame_index=np.zeros(1, int),
        present=np.ones((N, 1), bool),
        keypoints_px=of_birds("keypoints_px", K, 2),
        confidence=of_birds("confidence", K),
        box_px=of_birds("box_px", 4),
        image_size_px=np.array([records[0].size_px if records else (1, 1)], int),
        file_name=np.array([records[0].file_name if records else ""]),
        keypoint_names=tuple(names),
        skeleton=tuple(skeleton_pairs(names)),
        masks={(n, 0): record.masks[m] for n, (record, m) in enumerate(birds)},
        own_images={(n, 0): (record.file_name, *record.size_px) for n, (record, _) in enumerate(birds)},
        score=of_birds("score"),
    )
