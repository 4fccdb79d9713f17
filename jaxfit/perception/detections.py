"""The detections of every frame of a video: instances, and the keypoints of some of them on request."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.clock import Clock
from jaxfit.perception.instances import Instance, KeypointDetector, Segmenter
from jaxfit.video.reader import FrameReader

__all__ = [
    "Detections",
    "Distances",
    "FrameDetections",
    "Keypoints",
    "LocalDetections",
    "joined_distances",
    "single_opencv_thread",
]

Keypoints = tuple[Float[np.ndarray, "_ K 2"], Float[np.ndarray, "_ K"]]
"""Positions in image pixels and confidences, as `KeypointDetector` returns them."""
Distances = tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]
"""Distances of the activations of the segmenter and of the keypoint network; empty for networks without statistics."""


class FrameDetections(NamedTuple):
    """The detections of one frame."""

    frame_index: int
    time_s: float | None
    size_px: tuple[int, int]
    """Width and height."""
    instances: list[Instance]
    keypoints: Callable[[Sequence[int]], Keypoints]
    """Function that returns the keypoints of the instances at some positions."""
    picture: UInt8[np.ndarray, "H W 3"] | None
    """None where another process has read the picture."""


class Detections(Protocol):
    """Detections of the frames of a video, in the order of the frames."""

    @property
    def damaged(self) -> list[int]:
        """Numbers of the frames so far that could not be read."""
        ...

    def __iter__(self) -> Generator[FrameDetections]:
        """Yield the detections of every frame that can be read."""
        ...

    def take_distances(self) -> Distances:
        """Return the distances of the frames since the last call."""
        ...


class LocalDetections:
    """Detections by networks in this process.

    Args:
        reader: the frames.
        segmenter, keypoints: the networks.
        clock: measures the parts of the work.
    """

    def __init__(self, reader: FrameReader, segmenter: Segmenter, keypoints: KeypointDetector, clock: Clock):
        self._reader, self._segmenter, self._keypoints, self._clock = reader, segmenter, keypoints, clock
        self.take_distances()  # those of an earlier video

    @property
    def damaged(self) -> list[int]:
        """Numbers of the frames so far that could not be read."""
        return self._reader.damaged

    def __iter__(self) -> Generator[FrameDetections]:
        with single_opencv_thread():
            for number, picture, time_s in self._clock.each("decode", self._reader):
                with self._clock("segment"):
                    instances = self._segmenter(picture)
                size_px = (picture.shape[1], picture.shape[0])
                keypoints = partial(self._keypoints_of, picture, instances)
                yield FrameDetections(number, time_s, size_px, instances, keypoints, picture)

    def _keypoints_of(self, picture: np.ndarray, instances: Sequence[Instance], some: Sequence[int]) -> Keypoints:
        with self._clock("keypoints"):
            return self._keypoints(picture, [instances[i] for i in some])

    def take_distances(self) -> Distances:
        """Return the distances of the frames since the last call."""
        monitors = (getattr(network, "activations", None) for network in (self._segmenter, self._keypoints))
        segmenter, keypoints = (np.zeros(0) if monitor is None else np.asarray(monitor.take()) for monitor in monitors)
        return segmenter, keypoints


def joined_distances(parts: Iterable[Distances]) -> Distances:
    """Return the distances of some parts of a video as those of one part."""
    segmenter, keypoints = zip(*parts, (np.zeros(0), np.zeros(0)), strict=True)
    return np.concatenate(segmenter), np.concatenate(keypoints)


@contextmanager
def single_opencv_thread() -> Iterator[None]:
    """Restrict OpenCV to one thread: the networks use all cores, and OpenCV's threads would slow them down."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
