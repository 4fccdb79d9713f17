"""From results frame by frame to observations, without holding a frame."""

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


class _Sighting(NamedTuple):
    """One tracked bird in one frame."""

    t: int
    box_px: np.ndarray
    score: float
    rle: dict[str, Any]
    keypoints_px: np.ndarray
    confidence: np.ndarray


class TrackRecorder:
    """Collects what was found in each frame; a bird takes a kilobyte or two a frame.

    Args:
        keypoint_names: K names in the order of the detector's output.
        skeleton: pairs of keypoints, counted from 0, that a drawing connects.
    """

    def __init__(self, keypoint_names: Sequence[str], skeleton: Sequence[tuple[int, int]] = ()):
        self._names, self._skeleton = tuple(keypoint_names), tuple(skeleton)
        self._frames: list[_Frame] = []
        self._tracks: dict[int, list[_Sighting]] = {}

    def add(
        self,
        frame_index: int,
        file_name: str,
        size_px: tuple[int, int],
        instances: Sequence[Instance],
        identities: Sequence[int | None],
        keypoints_px: Float[np.ndarray, "M K 2"],
        confidence: Float[np.ndarray, "M K"],
    ) -> None:
        """Take down one frame, also one without a bird; damaged frames are left out altogether.

        Args:
            frame_index: number of the frame in the video; it increases from call to call.
            file_name: what the frame is called.
            size_px: its width and height.
            instances: M birds.
            identities: what a tracker says of them; those that are None are left out.
            keypoints_px: x, y in image pixels.
            confidence: within [0, 1]; 0 where a keypoint was not found.

        Raises:
            ValueError: a `frame_index` that does not increase, an identity that stands twice, arrays of other lengths
                or for other keypoints.
        """
        if self._frames and frame_index <= self._frames[-1].frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frames[-1].frame_index}")
        tracked = [one for one in identities if one is not None]
        if len(set(tracked)) < len(tracked):
            raise ValueError(f"identities must name each bird once, not {list(identities)}")
        shape = (len(instances), len(self._names))
        if np.shape(keypoints_px) != (*shape, 2) or np.shape(confidence) != shape:
            raise ValueError(
                f"keypoints_px and confidence must have shapes {(*shape, 2)} and {shape}, "
                f"not {np.shape(keypoints_px)} and {np.shape(confidence)}"
            )
        t = len(self._frames)
        self._frames.append(_Frame(int(frame_index), file_name, size_px))
        for instance, one, points, trust in zip(instances, identities, keypoints_px, confidence, strict=True):
            if one is not None:
                rle = instance.encode(*size_px)
                sighting = _Sighting(t, instance.box_px, instance.score, rle, np.array(points), np.array(trust))
                self._tracks.setdefault(one, []).append(sighting)

    def observations(self) -> Observations:
        """Everything so far; tracks in the order of their identities, perhaps none."""
        tracks = sorted(self._tracks)
        N, T, K = len(tracks), len(self._frames), len(self._names)
        present, score = np.zeros((N, T), bool), np.zeros((N, T), np.float32)
        keypoints_px, confidence = np.zeros((N, T, K, 2), np.float32), np.zeros((N, T, K), np.float32)
        box_px = np.zeros((N, T, 4), np.float32)
        masks = {}
        for n, one in enumerate(tracks):
            for seen in self._tracks[one]:
                cell = n, seen.t
                present[cell], score[cell], box_px[cell], masks[cell] = True, seen.score, seen.box_px, seen.rle
                keypoints_px[cell], confidence[cell] = seen.keypoints_px, seen.confidence
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
        )
