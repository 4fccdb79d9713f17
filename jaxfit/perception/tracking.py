"""Trackers, the records of frames, and the tracks that are skipped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.data.footage import FootageIdentity
from jaxfit.data.masks import box_iou
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.perception.external_trackers import EXTERNAL_TRACKERS, ExternalTracker
from jaxfit.perception.network import Instance


class IouTracker:
    """A tracker that maximises the sum of box IoUs between the birds of a frame and the last boxes of the tracks.

    A box is the tight box of an instance's mask. The assignment is one to one, over pairs whose IoU is above `min_iou`.
    A track without an instance keeps its last box for `memory` frames. An instance without a track starts a new track.

    Args:
        memory: number of frames for which a bird may be missed; frames that are absent from the video count as missed.
        min_iou: lower bound of the intersection over union; a pair must exceed this value.
        step: difference between the numbers of consecutive processed frames.

    Source: Hägerlind et al. 2024, the tracker over masks.
    """

    def __init__(self, memory: int = 5, min_iou: float = 0.1, step: int = 1):
        self._max_age, self._min_iou = (memory + 1) * step, min_iou
        self._last_seen: dict[int, tuple[int, np.ndarray]] = {}  # identity → number and box of its last frame
        self._next_identity, self._frame_index = 1, -1

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """Return the identities of one frame's instances, as `Tracker` describes; every instance has an identity."""
        if frame_index <= self._frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frame_index}")
        self._frame_index = frame_index
        self._last_seen = {
            identity: last for identity, last in self._last_seen.items() if frame_index - last[0] <= self._max_age
        }
        boxes_px = np.array([instance.box_px for instance in instances], np.float64).reshape(-1, 4)
        known = list(self._last_seen)
        last_boxes_px = np.array([self._last_seen[identity][1] for identity in known]).reshape(-1, 4)
        iou = box_iou(last_boxes_px[:, None], boxes_px[None])
        iou[iou <= self._min_iou] = 0
        assigned = {
            int(column): known[row]
            for row, column in zip(*linear_sum_assignment(iou, maximize=True), strict=True)
            if iou[row, column] > 0
        }
        identities: list[int | None] = []
        for column, box_px in enumerate(boxes_px):
            identity = assigned.get(column, self._next_identity)
            self._next_identity = max(self._next_identity, identity + 1)
            self._last_seen[identity] = frame_index, box_px
            identities.append(identity)
        return identities


TRACKERS = ("iou", *EXTERNAL_TRACKERS)
"""The names that `load_tracker` accepts."""


@runtime_checkable
class Tracker(Protocol):
    """Assigns each bird an identity that is constant from frame to frame."""

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """Return the identities of one frame's instances.

        Args:
            frame_index: number of the frame in the video; it increases from call to call. A skipped frame counts as a
                frame without instances.
            instances: the instances of the frame.
            frame: the picture, for trackers that use it.

        Returns:
            One identity (1 or more) for each instance. The identities of a frame differ, and an identity is never
            reused for another bird. None where the instance has no track, or no track yet.

        Raises:
            ValueError: `frame_index` does not increase.
        """
        ...


def load_tracker(
    name: str = "iou", *, memory: int = 5, min_iou: float = 0.1, min_score: float = 0.6, step: int = 1
) -> Tracker:
    """Create a tracker for one video.

    Args:
        name: `iou`, the paper's tracker; or `bytetrack`, `ocsort` or `botsort` of the optional `trackers` package.
            These three predict the position of each bird, which helps where birds cross.
        memory: number of frames for which a bird may be missed without losing its identity.
        min_iou: lower bound of the IoU between boxes of the same bird.
        min_score: instances with a lower score start no track; the tracker `iou` uses all instances.
        step: difference between the numbers of consecutive processed frames.

    Raises:
        InputError: unknown name, or a package that is not installed.
        ValueError: a setting outside its range.
    """
    if memory < 0 or not 0 <= min_iou <= 1 or not 0 <= min_score <= 1 or step < 1:
        raise ValueError(
            "memory must be 0 or more, min_iou and min_score within [0, 1], step 1 or more, "
            f"not {memory}, {min_iou}, {min_score}, {step}"
        )
    if name == "iou":
        return IouTracker(memory, min_iou, step)
    if name in EXTERNAL_TRACKERS:
        return ExternalTracker(name, memory, min_iou, min_score, step)
    raise InputError(f"tracker {name}", "is unknown", f"choose one of {', '.join(TRACKERS)}")


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
    segmenter_distance: Float[np.ndarray, "_"]
    keypoint_distance: Float[np.ndarray, "_"]
    """Distances of the activations of the networks; empty for networks without statistics."""


def record_frame(
    frame_index: int,
    file_name: str,
    size_px: tuple[int, int],
    instances: Sequence[Instance],
    identities: Sequence[int | None],
    keypoints_px: Float[np.ndarray, "M K 2"],
    confidence: Float[np.ndarray, "M K"],
    time_s: float | None = None,
    distances: tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]] = (np.zeros(0), np.zeros(0)),
) -> RecordedFrame:
    """Return the record of a frame; an instance needs one or two kilobytes.

    Args:
        frame_index: number of the frame in the video.
        file_name: name of the frame.
        size_px: width and height of the frame.
        instances: M instances.
        identities: the tracker's identity of each instance; instances with None are in no observations.
        keypoints_px: x, y in image pixels.
        confidence: within [0, 1]; 0 where a keypoint was not detected.
        time_s: presentation time of the frame in seconds; None if unknown.
        distances: `segmenter_distance` and `keypoint_distance`.

    Raises:
        ValueError: an identity occurs twice, or an array has another number of instances.
    """
    tracked = [i for i, identity in enumerate(identities) if identity is not None]
    if len({identities[i] for i in tracked}) < len(tracked):
        raise ValueError(f"identities must contain each bird once, not {list(identities)}")
    lengths = len(keypoints_px), len(confidence)
    if lengths != (len(instances), len(instances)):
        raise ValueError(f"keypoints_px and confidence must have {len(instances)} instances, not {lengths}")
    return RecordedFrame(
        frame_index=int(frame_index),
        file_name=file_name,
        size_px=size_px,
        time_s=np.nan if time_s is None else time_s,
        box_px=np.array([instance.box_px for instance in instances], np.float32).reshape(-1, 4),
        score=np.array([instance.score for instance in instances], np.float64),
        identity=np.array([identity or 0 for identity in identities], np.int64),
        masks=tuple(instances[i].encode(*size_px) for i in tracked),
        keypoints_px=np.asarray(keypoints_px, np.float32)[tracked],
        confidence=np.asarray(confidence, np.float32)[tracked],
        segmenter_distance=distances[0],
        keypoint_distance=distances[1],
    )


def all_distances(frames: Sequence[RecordedFrame]) -> list[list[float]]:
    """Return the distances of the activations in all frames: those of the segmenter, and of the keypoint network."""
    pairs = [(frame.segmenter_distance, frame.keypoint_distance) for frame in frames]
    return [[number for pair in pairs for number in pair[i].tolist()] for i in (0, 1)]


def observations_of(
    frames: Sequence[RecordedFrame],
    names: Sequence[str],
    skeleton: Sequence[tuple[int, int]] = (),
    fps: float | None = None,
    footage: FootageIdentity | None = None,
) -> Observations:
    """Return the observations of frames; tracks are sorted by identity, and there may be no track.

    Args:
        frames: frames of increasing numbers; a damaged frame is absent.
        names: K names in the order of the detector's output.
        skeleton: pairs of keypoint indices that a drawing connects.
        fps: mean frame rate of the video in frames per second; None if unknown.
        footage: identity of the video; None if unknown.
    """
    tracks = sorted({identity for frame in frames for identity in frame.identity.tolist() if identity})
    row = {identity: n for n, identity in enumerate(tracks)}
    N, T, K = len(tracks), len(frames), len(names)
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
        keypoint_names=tuple(names),
        skeleton=tuple(skeleton),
        masks=dict(sorted(masks.items())),
        score=score,
        timestamp_s=np.array([frame.time_s for frame in frames], float),
        fps=fps,
        footage=footage,
    )
