"""Detections by worker processes, which read the video and the networks themselves."""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxfit.config.perception import FramesConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import Clock
from jaxfit.foundation.workers import Cluster, FailedTask
from jaxfit.perception.detections import (
    Distances,
    FrameDetections,
    Keypoints,
    LocalDetections,
    joined_distances,
    network_files,
    open_keypoint_detector,
    open_segmenter,
)
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import read_frames, warn_of_damage

FRAMES_PER_TASK = 25
"""Frames of a task. A task begins with a jump into the video, which decodes from the keyframe before."""

_logger = logging.getLogger(__name__)


class DetectionShared(NamedTuple):
    """The data that all tasks share."""

    video: Path
    """Absolute path of the video or of the folder of frames, the same on all machines."""
    config: TrackConfig
    """The networks, with absolute paths."""
    sizes: tuple[int, ...]
    """Sizes of the video and of the files of the networks in bytes; of a folder, the number of its pictures."""


class PackedInstance(NamedTuple):
    """An instance without a network: its mask has one bit per pixel."""

    bits: UInt8[np.ndarray, "bytes"]
    shape: tuple[int, int]
    x0: int
    y0: int
    score: float
    label: str


class DetectedFrame(NamedTuple):
    """The detections of one frame, as a worker sends them."""

    frame_index: int
    time_s: float | None
    size_px: tuple[int, int]
    instances: list[PackedInstance]
    keypoints: Keypoints
    """Keypoints of all instances."""
    distances: Distances


class DetectedRange(NamedTuple):
    """The result of a task."""

    frames: list[DetectedFrame]
    damaged: list[int]
    """Numbers of the frames of the range that cannot be read."""


class WorkerDetections:
    """Detections by worker processes.

    The keypoints of all instances are detected, because the tracker works in this process.

    Args:
        cluster: the workers.
        video: a video, or a folder of frames, under the same path on all machines.
        config: the networks.
        frames: the frames that are read; the number of the last frame must be known.
        clock: measures the time until the workers send frames.

    Raises:
        InputError: during the iteration; a worker cannot read the video or a network.
    """

    damaged: list[int]
    """Numbers of the frames so far that could not be read, or that no worker could compute."""

    def __init__(self, cluster: Cluster, video: Path, config: TrackConfig, frames: range, clock: Clock):
        self._cluster, self._step, self._clock = cluster, frames.step, clock
        self._ranges = [frames[i : i + FRAMES_PER_TASK] for i in range(0, len(frames), FRAMES_PER_TASK)]
        config = _with_absolute_paths(config)
        sizes = tuple(_state(file)[0] for file in _files(video, config))
        self._shared = DetectionShared(video, config, sizes)
        self._distances: list[Distances] = []
        self.damaged = []

    def __iter__(self) -> Generator[FrameDetections]:
        self.damaged = []
        try:
            for number, part in enumerate(self._clock.each("detect", self._parts())):
                if isinstance(part, FailedTask):
                    self.damaged += self._ranges[number]
                    _logger.warning("%s: no detections: %s", self._shared.video, part.reason)
                    continue
                damaged = list(part.damaged)
                for frame in part.frames:
                    while damaged and damaged[0] < frame.frame_index:
                        self.damaged.append(damaged.pop(0))
                    self._distances.append(frame.distances)
                    instances = [_unpacked(each) for each in frame.instances]
                    yield FrameDetections(*frame[:3], instances, lambda found=frame.keypoints: found, None)
                self.damaged += damaged
        finally:
            warn_of_damage(self._shared.video, self.damaged, self._step)

    def _parts(self) -> Iterator[DetectedRange | FailedTask]:
        """Yield the results of the tasks in the order of the frames."""
        arrived: dict[int, DetectedRange | FailedTask] = {}
        wanted = 0
        for number, part in self._cluster.run(detect_range, self._shared, self._ranges):
            arrived[number] = part
            while wanted in arrived:
                yield arrived.pop(wanted)
                wanted += 1

    def take_distances(self) -> Distances:
        """Return the distances of the frames since the last call."""
        taken, self._distances = self._distances, []
        return joined_distances(taken)


def detect_range(shared: DetectionShared, frames: range) -> DetectedRange:
    """Detect the instances and keypoints of some frames, in a worker process.

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
        detections = LocalDetections(reader, *_networks(shared.config, states[1:]), Clock())
        found = [
            DetectedFrame(
                *frame[:3],
                [_packed(instance) for instance in frame.instances],
                frame.keypoints(),
                detections.take_distances(),
            )
            for frame in detections
        ]
    except InputError as error:
        raise InputError(f"worker on {platform.node()}: {error.source}", error.problem, error.remedy) from error
    return DetectedRange(found, reader.damaged)


@lru_cache(1)
def _networks(config: TrackConfig, _states: tuple[tuple[int, int], ...]) -> tuple[Segmenter, KeypointDetector]:
    """Load the networks of a config, and keep them for further tasks while their files have the same states."""
    if hasattr(os, "sched_getaffinity"):  # ONNX Runtime does not see that a worker has a share of the cores
        config = replace(config, threads=config.threads or len(os.sched_getaffinity(0)))
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
        return settings if settings.file == "builtin" else replace(settings, file=names[kind])

    own = {kind: absolute(getattr(config, kind), kind) for kind in names}
    return replace(config, frames=FramesConfig(), **own)


def _packed(instance: Instance) -> PackedInstance:
    return PackedInstance(np.packbits(instance.mask), instance.mask.shape, *instance[1:])


def _unpacked(packed: PackedInstance) -> Instance:
    height, width = packed.shape
    mask = np.unpackbits(packed.bits, count=height * width).reshape(height, width).astype(bool)
    return Instance(mask, *packed[2:])
