"""Detections by worker processes, which read the video and the networks themselves."""

from __future__ import annotations

import logging
import platform
from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.config.perception import BUILTIN, OUTLINE, FramesConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import Clock
from jaxfit.foundation.workers import Cluster, FailedTask
from jaxfit.perception.carried_masks import BLOCK_FRAMES
from jaxfit.perception.detections import (
    FrameDetections,
    detect,
    frames_at_once,
    network_files,
    open_keypoint_detector,
    open_segmenter,
)
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import read_frames, warn_of_damage

FRAMES_PER_TASK = 2 * BLOCK_FRAMES
"""Frames of a task, whole blocks. A task begins with a jump into the video, which decodes from the keyframe before."""

_logger = logging.getLogger(__name__)


class DetectionShared(NamedTuple):
    """The data that all tasks share."""

    video: Path
    """Absolute path of the video or of the folder of frames, the same on all machines."""
    config: TrackConfig
    """The networks, with absolute paths."""
    sizes: tuple[int, ...]
    """Sizes of the video and of the files of the networks in bytes; of a folder, the number of its pictures."""


class DetectedFrame(NamedTuple):
    """The detections of one frame, as a worker sends them."""

    detections: FrameDetections
    """Without picture; the masks have one bit per pixel."""
    shapes: list[tuple[int, int]]
    """Heights and widths of the masks."""


def detect_on_workers(
    cluster: Cluster, video: Path, config: TrackConfig, frames: range, clock: Clock
) -> Generator[FrameDetections | int]:
    """Return the detections of worker processes, as `jaxfit.perception.detections.detect`.

    Frames that no worker could compute count as damaged.

    Args:
        cluster: the workers.
        video: a video, or a folder of frames, under the same path on all machines.
        config: the networks.
        frames: the frames that are read; the number of the last frame must be known.
        clock: measures the time until the workers send frames.

    Raises:
        InputError: a network does not exist; during the iteration: a worker cannot read the video or a network.
    """
    return _in_order(cluster, shared_data(video, config), _ranges(frames), frames.step, clock)


def shared_data(video: Path, config: TrackConfig) -> DetectionShared:
    """Return the data that all tasks share.

    Raises:
        InputError: a network does not exist.
    """
    config = _with_absolute_paths(config)
    return DetectionShared(video, config, tuple(_state(file)[0] for file in _files(video, config)))


def _ranges(frames: range) -> list[range]:
    return [frames[i : i + FRAMES_PER_TASK] for i in range(0, len(frames), FRAMES_PER_TASK)]


def _in_order(
    cluster: Cluster, shared: DetectionShared, ranges: list[range], step: int, clock: Clock
) -> Generator[FrameDetections | int]:
    """Yield the detections of all tasks in the order of the frames."""
    damaged: list[int] = []

    def results() -> Iterator[list[DetectedFrame | int] | FailedTask]:
        arrived: dict[int, list[DetectedFrame | int] | FailedTask] = {}
        wanted = 0
        for number, result in cluster.run(detect_range, shared, ranges):
            arrived[number] = result
            while wanted in arrived:
                yield arrived.pop(wanted)
                wanted += 1

    try:
        for numbers, result in zip(ranges, clock.each("detect", results()), strict=False):
            if isinstance(result, FailedTask):
                _logger.warning("%s: no detections: %s", shared.video, result.reason)
            for item in numbers if isinstance(result, FailedTask) else result:
                if isinstance(item, int):
                    damaged.append(item)
                    yield item
                else:
                    yield _unpacked(item)
    finally:
        warn_of_damage(shared.video, damaged, step)


def detect_range(shared: DetectionShared, frames: range) -> list[DetectedFrame | int]:
    """Detect the instances and keypoints of some frames, in a worker process.

    Returns:
        The frames, and the numbers of the frames that cannot be read, in order.

    Raises:
        InputError: the video or a network cannot be read here, or the video differs from the video of the command.
    """
    try:
        files = _files(shared.video, shared.config)
        states = tuple(map(_state, files))
        for file, state, size in zip(files, states, shared.sizes, strict=True):
            if state[0] != size:
                raise InputError(file, "differs from the file of the command", "copy the same file to all machines")
        reader = read_frames(shared.video, frames.start, frames.stop, frames.step)
        segmenter, keypoints = _networks(shared.config, states[1:])
        detections = detect(reader, segmenter, keypoints, Clock(), frames_at_once(shared.config))
        return [item if isinstance(item, int) else _packed(item) for item in detections]
    except InputError as error:
        raise InputError(f"worker on {platform.node()}: {error.source}", error.problem, error.remedy) from error


@lru_cache(1)
def _networks(config: TrackConfig, _states: tuple[tuple[int, int], ...]) -> tuple[Segmenter, KeypointDetector]:
    """Load the networks of a config, and keep them for further tasks while their files have the same states."""
    return open_segmenter(config), open_keypoint_detector(config)


def _files(video: Path, config: TrackConfig) -> list[Path]:
    return [video, *(file for files in network_files(config).values() for file in files)]


def _state(file: Path) -> tuple[int, int]:
    """Return the size of a file in bytes (of a folder: its number of pictures) and the time of its last change.

    Raises:
        InputError: there is no such file.
    """
    try:
        state = file.stat()
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror}", "copy the file to all machines") from error
    return len(image_files(file)) if file.is_dir() else state.st_size, state.st_mtime_ns


def _with_absolute_paths(config: TrackConfig) -> TrackConfig:
    names = {kind: "+".join(str(file.absolute()) for file in files) for kind, files in network_files(config).items()}

    def absolute(settings: Any, kind: str) -> Any:
        return settings if settings.file in (BUILTIN, OUTLINE) else replace(settings, file=names[kind])

    own = {kind: absolute(getattr(config, kind), kind) for kind in names}
    return replace(config, frames=FramesConfig(), **own)


def _packed(detections: FrameDetections) -> DetectedFrame:
    shapes = [instance.mask.shape for instance in detections.instances]
    instances = [instance._replace(mask=np.packbits(instance.mask)) for instance in detections.instances]
    return DetectedFrame(detections._replace(instances=instances, picture=None), shapes)


def _unpacked(detected: DetectedFrame) -> FrameDetections:
    instances = [
        instance._replace(mask=np.unpackbits(instance.mask, count=height * width).reshape(height, width).astype(bool))
        for instance, (height, width) in zip(detected.detections.instances, detected.shapes, strict=True)
    ]
    return detected.detections._replace(instances=instances)
