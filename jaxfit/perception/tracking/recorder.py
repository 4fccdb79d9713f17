"""Collects the results of each frame into observations, without keeping pictures in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.data.observations import Observations
from jaxfit.perception.instances import Instance

__all__ = ["TrackRecorder"]


class _Frame(NamedTuple):
    frame_index: int
    file_name: str
    size_px: tuple[int, int]
    time_s: float | None


class _TrackedInstance(NamedTuple):
    """One instance of a track."""

    t: int
    box_px: np.ndarray
    score: float
    rle: dict[str, Any]
    keypoints_px: np.ndarray
    confidence: np.ndarray


class TrackRecorder:
    """Collects the tracked instances of all frames; one instance needs one or two kilobytes.

    Args:
        keypoint_names: K names in the order of the detector's output.
        skeleton: pairs of keypoint indices that a drawing connects.
        fps: mean frame rate of the video in frames per second; None if unknown.
    """

    def __init__(
        self, keypoint_names: Sequence[str], skeleton: Sequence[tuple[int, int]] = (), fps: float | None = None
    ):
        self._names, self._skeleton, self._fps = tuple(keypoint_names), tuple(skeleton), fps
        self._frames: list[_Frame] = []
        self._tracks: dict[int, list[_TrackedInstance]] = {}

    def add(
        self,
        frame_index: int,
        file_name: str,
        size_px: tuple[int, int],
        instances: Sequence[Instance],
        identities: Sequence[int | None],
        keypoints_px: Float[np.ndarray, "M K 2"],
        confidence: Float[np.ndarray, "M K"],
        time_s: float | None = None,
    ) -> None:
        """Add one frame; a frame without instances is added too, a damaged frame is not.

        Args:
            frame_index: number of the frame in the video; it increases from call to call.
            file_name: name of the frame.
            size_px: width and height of the frame.
            instances: M instances.
            identities: the tracker's identity of each instance; instances with None are skipped.
            keypoints_px: x, y in image pixels.
            confidence: within [0, 1]; 0 where a keypoint was not detected.
            time_s: presentation time of the frame in seconds; None if unknown.

        Raises:
            ValueError: `frame_index` does not increase, an identity occurs twice, or an array has the wrong shape.
        """
        if self._frames and frame_index <= self._frames[-1].frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frames[-1].frame_index}")
        tracked = [identity for identity in identities if identity is not None]
        if len(set(tracked)) < len(tracked):
            raise ValueError(f"identities must contain each bird once, not {list(identities)}")
        shape = (len(instances), len(self._names))
        if np.shape(keypoints_px) != (*shape, 2) or np.shape(confidence) != shape:
            raise ValueError(
                f"keypoints_px and confidence must have shapes {(*shape, 2)} and {shape}, "
                f"not {np.shape(keypoints_px)} and {np.shape(confidence)}"
            )
        t = len(self._frames)
        self._frames.append(_Frame(int(frame_index), file_name, size_px, time_s))
        for instance, identity, points_px, point_confidence in zip(
            instances, identities, keypoints_px, confidence, strict=True
        ):
            if identity is not None:
                rle = instance.encode(*size_px)
                self._tracks.setdefault(identity, []).append(
                    _TrackedInstance(
                        t, instance.box_px, instance.score, rle, np.array(points_px), np.array(point_confidence)
                    )
                )

    def observations(self) -> Observations:
        """Return the observations of all frames so far; tracks are sorted by identity, and there may be no track."""
        tracks = sorted(self._tracks)
        N, T, K = len(tracks), len(self._frames), len(self._names)
        present, score = np.zeros((N, T), bool), np.zeros((N, T), np.float32)
        keypoints_px, confidence = np.zeros((N, T, K, 2), np.float32), np.zeros((N, T, K), np.float32)
        box_px = np.zeros((N, T, 4), np.float32)
        masks = {}
        for n, identity in enumerate(tracks):
            for tracked in self._tracks[identity]:
                at = n, tracked.t
                present[at], score[at], box_px[at], masks[at] = True, tracked.score, tracked.box_px, tracked.rle
                keypoints_px[at], confidence[at] = tracked.keypoints_px, tracked.confidence
        return Observations(
            track_id=np.array(tracks, int),
            frame_index=np.array([frame.frame_index for frame in self._frames], int),
            present=present,
            keypoints_px=keypoints_px,
            confidence=confidence,
            box_px=box_px,
            image_size_px=np.array([frame.size_px for frame in self._frames], int).reshape(T, 2),
            file_name=np.array([frame.file_name for frame in self._frames], str),
            keypoint_names=self._names,
            skeleton=self._skeleton,
            masks=masks,
            score=score,
            timestamp_s=np.array([np.nan if frame.time_s is None else frame.time_s for frame in self._frames], float),
            fps=self._fps,
        )
