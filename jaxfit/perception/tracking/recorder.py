"""Collects the results of each frame into observations, without keeping pictures in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.data.footage import FootageIdentity
from jaxfit.data.observations import Observations
from jaxfit.perception.instances import Instance

__all__ = ["RecordedFrame", "TrackRecorder"]


class RecordedFrame(NamedTuple):
    """One frame with M instances, of which m have a track; K keypoints."""

    frame_index: int
    file_name: str
    size_px: tuple[int, int]
    """Width and height."""
    time_s: float
    """Presentation time of the frame in seconds; NaN if unknown."""
    box_px: Float[np.ndarray, "M 4"]
    """Tight box of every instance: x, y, width, height; image pixels."""
    score: Float[np.ndarray, "M"]
    identity: Int[np.ndarray, "M"]
    """Identity of every instance; 0 without a track."""
    masks: tuple[dict[str, Any], ...]
    """Run lengths of the mask of each of the m tracked instances over the frame."""
    keypoints_px: Float[np.ndarray, "m K 2"]
    confidence: Float[np.ndarray, "m K"]


class TrackRecorder:
    """Collects the tracked instances of all frames; one instance needs one or two kilobytes.

    Args:
        keypoint_names: K names in the order of the detector's output.
        skeleton: pairs of keypoint indices that a drawing connects.
        fps: mean frame rate of the video in frames per second; None if unknown.
        footage: identity of the video; None if unknown.
    """

    frames: list[RecordedFrame]
    """The frames so far."""

    def __init__(
        self,
        keypoint_names: Sequence[str],
        skeleton: Sequence[tuple[int, int]] = (),
        fps: float | None = None,
        footage: FootageIdentity | None = None,
    ):
        self._names, self._skeleton, self._fps, self._footage = tuple(keypoint_names), tuple(skeleton), fps, footage
        self.frames = []

    @property
    def num_keypoints(self) -> int:
        """Number of keypoints K."""
        return len(self._names)

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
            identities: the tracker's identity of each instance; instances with None are in no observations.
            keypoints_px: x, y in image pixels.
            confidence: within [0, 1]; 0 where a keypoint was not detected.
            time_s: presentation time of the frame in seconds; None if unknown.

        Raises:
            ValueError: `frame_index` does not increase, an identity occurs twice, or an array has the wrong shape.
        """
        if self.frames and frame_index <= self.frames[-1].frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self.frames[-1].frame_index}")
        tracked = [i for i, identity in enumerate(identities) if identity is not None]
        if len({identities[i] for i in tracked}) < len(tracked):
            raise ValueError(f"identities must contain each bird once, not {list(identities)}")
        shape = (len(instances), len(self._names))
        if np.shape(keypoints_px) != (*shape, 2) or np.shape(confidence) != shape:
            raise ValueError(
                f"keypoints_px and confidence must have shapes {(*shape, 2)} and {shape}, "
                f"not {np.shape(keypoints_px)} and {np.shape(confidence)}"
            )
        self.frames.append(
            RecordedFrame(
                int(frame_index),
                file_name,
                size_px,
                np.nan if time_s is None else time_s,
                np.array([instance.box_px for instance in instances], np.float32).reshape(-1, 4),
                np.array([instance.score for instance in instances], np.float64),
                np.array([identity or 0 for identity in identities], np.int64),
                tuple(instances[i].encode(*size_px) for i in tracked),
                np.asarray(keypoints_px, np.float32)[tracked],
                np.asarray(confidence, np.float32)[tracked],
            )
        )

    def observations(self, first: int = 0) -> Observations:
        """Return the observations of the frames so far; tracks are sorted by identity, and there may be no track.

        Args:
            first: position of the first frame; tracks without a detection from this frame on are left out.
        """
        frames = self.frames[first:]
        tracks = sorted({identity for frame in frames for identity in frame.identity.tolist() if identity})
        row = {identity: n for n, identity in enumerate(tracks)}
        N, T, K = len(tracks), len(frames), len(self._names)
        present, score = np.zeros((N, T), bool), np.zeros((N, T), np.float32)
        keypoints_px, confidence = np.zeros((N, T, K, 2), np.float32), np.zeros((N, T, K), np.float32)
        box_px = np.zeros((N, T, 4), np.float32)
        masks = {}
        for t, frame in enumerate(frames):
            tracked = frame.identity > 0
            rows = [row[identity] for identity in frame.identity[tracked].tolist()]
            present[rows, t], score[rows, t], box_px[rows, t] = True, frame.score[tracked], frame.box_px[tracked]
            keypoints_px[rows, t], confidence[rows, t] = frame.keypoints_px, frame.confidence
            masks |= {(n, t): mask for n, mask in zip(rows, frame.masks, strict=True)}
        return Observations(
            track_id=np.array(tracks, int),
            frame_index=np.array([frame.frame_index for frame in frames], int),
            present=present,
            keypoints_px=keypoints_px,
            confidence=confidence,
            box_px=box_px,
            image_size_px=np.array([frame.size_px for frame in frames], int).reshape(T, 2),
            file_name=np.array([frame.file_name for frame in frames], str),
            keypoint_names=self._names,
            skeleton=self._skeleton,
            masks=dict(sorted(masks.items())),
            score=score,
            timestamp_s=np.array([frame.time_s for frame in frames], float),
            fps=self._fps,
            footage=self._footage,
        )
