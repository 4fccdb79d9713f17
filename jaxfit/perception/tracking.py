"""Trackers, the record of tracks, and their corrections: flips of left and right, skipped tracks.

Repair of left-right flips: frames in which the detector exchanged left and right keypoints. The cue is the vector from
the left to the right keypoint of a pair. The vector of a turning bird changes slowly; a flip reverses the vector within
one frame, and reverses it again later. For each bird, dynamic programming chooses the states of all frames (as
detected, or flipped) together: first with all pairs in the same state, then for each pair on its own. Let v be the
vector, s = ±1 the state, w the lower confidence of the two keypoints, and m the median of |v(t) − v(t−1)| over the
track. The transition from frame t' to frame t, at most MAX_FRAMES frames later, costs

    min(w(t), w(t')) · min(|s(t) v(t) − s(t') v(t')| / (m √(t − t')), MAX_CHANGE),

plus STATE_CHANGE_COST if the state changes, plus MAX_CHANGE · w for each frame in between that is skipped as an
outlier, plus FLIP_COST · w for each flipped frame. Across a longer gap no transition is compared and only the last term
remains: without neighbours, the detected sides are kept. If two parts of a track contradict each other, the part with
the smaller sum of w is flipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.data.footage import FootageIdentity
from jaxfit.data.masks import box_iou
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_step
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


def drop_short_tracks(observations: Observations, min_track_frames: int) -> Observations:
    """Exclude the tracks that have detections in fewer than `min_track_frames` frames.

    Only frames with a detection of the bird count, not the frames in between. The frames of the video and the
    identities of the other tracks do not change.
    """
    return observations.select(tracks=observations.present.sum(1) >= min_track_frames)


def drop_low_scores(observations: Observations, min_track_score: float) -> Observations:
    """Exclude the tracks whose mean score is below `min_track_score`; observations without scores do not change."""
    return observations.select(tracks=~(mean_scores(observations) < min_track_score))


def mean_scores(observations: Observations) -> Float[np.ndarray, "N"]:
    """Return the mean score of the detections of every track; NaN without scores or without detections."""
    if observations.score is None:
        return np.full(observations.num_tracks, np.nan)
    total = np.where(observations.present, observations.score, 0).sum(1)
    count = observations.present.sum(1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


MAX_FRAMES = 8
"""Largest distance, in frames, between two frames that are compared."""
MAX_CHANGE = 6.0
"""Upper bound of the change of the vector, in units of its median change."""
STATE_CHANGE_COST = 1.0
"""Cost of a change of state, in units of the median change of the vector."""
FLIP_COST = 0.2
"""Cost of a flipped frame. A long flip is more probably a bird that turned around."""
MIN_MEDIAN_CHANGE = 0.005
"""Lower bound of the median change of the vector, as a share of the longer side of the box."""


def repair_left_right_flips(
    observations: Observations, keypoint_pairs: Sequence[tuple[int, int]]
) -> tuple[Observations, Bool[np.ndarray, "N T P"]]:
    """Exchange left and right keypoints in the frames in which the detector flipped them.

    Args:
        observations: the detections.
        keypoint_pairs: P pairs (left, right) of keypoint indices.

    Returns:
        The observations with the flipped keypoints (positions, confidences, occlusion) exchanged back, and the mask of
        the flipped pairs. A frame without detections between two flipped frames counts as flipped.
    """
    N, T = observations.present.shape
    pairs = np.array(keypoint_pairs, int).reshape(-1, 2)
    P = len(pairs)
    if not N or T < 2 or not P:
        return observations, np.zeros((N, T, P), bool)
    side_px = np.where(observations.present, observations.box_px[..., 2:].max(-1), 1)
    ends = observations.keypoints_px[:, :, pairs].astype(np.float64)  # N T P 2 xy
    vector = (ends[..., 1, :] - ends[..., 0, :]) / np.maximum(side_px, 1)[..., None, None]
    weight = observations.confidence[:, :, pairs].min(-1).astype(np.float64)
    numbers = observations.frame_index
    time = (numbers - numbers[0]) // frame_step(numbers)
    median_change = _median_change(vector, weight, time)

    common = _flipped_frames(vector, weight, time, median_change)[..., None]
    vector = np.where(common[..., None], -vector, vector)
    single_vectors = np.moveaxis(vector, 2, 1).reshape(N * P, T, 1, 2)
    single_weights = np.moveaxis(weight, 2, 1).reshape(N * P, T, 1)
    single = _flipped_frames(single_vectors, single_weights, time, median_change.reshape(N * P, 1)).reshape(N, P, T)
    flipped = common ^ np.moveaxis(single, 1, 2)
    return _exchange(observations, pairs, flipped), flipped


def _median_change(
    vector: Float[np.ndarray, "N T P 2"], weight: Float[np.ndarray, "N T P"], time: Int[np.ndarray, "T"]
) -> Float[np.ndarray, "N P"]:
    """Compute the median change of the vector between consecutive frames."""
    known = (weight[:, 1:] > 0) & (weight[:, :-1] > 0) & (np.diff(time) == 1)[:, None]
    change = np.where(known, np.linalg.norm(np.diff(vector, axis=1), axis=-1), np.nan)
    change[:, 0] = np.where(known.any(1), change[:, 0], 1)  # no consecutive frames: the size of the box
    return np.maximum(np.nanmedian(change, axis=1), MIN_MEDIAN_CHANGE)


def _flipped_frames(
    vector: Float[np.ndarray, "B T P 2"],
    weight: Float[np.ndarray, "B T P"],
    time: Int[np.ndarray, "T"],
    median_change: Float[np.ndarray, "B P"],
) -> Bool[np.ndarray, "B T"]:
    """Choose the flipped frames of each of B problems by dynamic programming; the P pairs of a problem flip together.

    `cost[:, t, s]` is the cost of the best path that ends in frame t and state s. `previous` holds the frame and state
    before, and `compared` whether the transition was compared. `best_cost` and `best_end` hold the best path so far.
    """
    B, T, _ = weight.shape
    problems, total_weight = np.arange(B), weight.sum(-1)
    skip_cost = np.concatenate([np.zeros((B, 1)), np.cumsum(MAX_CHANGE * total_weight, axis=1)], axis=1)
    cost = np.zeros((B, T, 2))
    previous = np.full((B, T, 2, 2), -1)
    compared = np.zeros((B, T, 2), bool)
    best_cost, best_end = np.zeros(B), np.full((B, 2), -1)
    signs, change_cost = np.array([1.0, -1.0]), np.array([0.0, STATE_CHANGE_COST])
    for t in range(T):
        first = int(np.searchsorted(time, time[t] - MAX_FRAMES))
        restart_cost = best_cost + MAX_CHANGE * total_weight[:, t]
        cost[:, t], previous[:, t] = restart_cost[:, None], best_end[:, None]
        if first < t:
            # shapes: `change` (B, earlier, P, state), then (B, earlier, state); `path` (B, earlier, now, then)
            both = np.minimum(weight[:, t, None], weight[:, first:t])
            unit = median_change[:, None] * np.sqrt(time[t] - time[first:t])[None, :, None]
            difference = vector[:, t, None, :, None] - signs[:, None] * vector[:, first:t, :, None]
            change = np.minimum(np.linalg.norm(difference, axis=-1) / unit[..., None], MAX_CHANGE)
            change = (both[..., None] * change).sum(2) + change_cost
            skipped = skip_cost[:, t, None] - skip_cost[:, first + 1 : t + 1]
            path = cost[:, first:t, None] + skipped[..., None, None] + change[..., [[0, 1], [1, 0]]]
            path[~both.any(axis=-1)] = np.inf
            path = np.moveaxis(path, 2, 1).reshape(B, 2, -1)
            best = path.argmin(-1)
            lowest = np.take_along_axis(path, best[..., None], -1)[..., 0]
            compared[:, t] = lowest <= restart_cost[:, None]
            origin = np.stack([first + best // 2, best % 2], axis=-1)
            cost[:, t] = np.where(compared[:, t], lowest, cost[:, t])
            previous[:, t] = np.where(compared[:, t, :, None], origin, previous[:, t])
        cost[:, t, 1] += FLIP_COST * total_weight[:, t]
        state = cost[:, t].argmin(-1)
        ends_here = (total_weight[:, t] > 0) & (cost[problems, t, state] <= restart_cost)
        best_cost = np.where(ends_here, cost[problems, t, state], restart_cost)
        best_end = np.where(ends_here[:, None], np.stack([np.full(B, t), state], axis=-1), best_end)
    return np.stack([_trace_back(best_end[b], previous[b], compared[b]) for b in range(B)])


def _trace_back(end: np.ndarray, previous: np.ndarray, compared: np.ndarray) -> Bool[np.ndarray, "T"]:
    """Follow the best path back from its end; skipped frames between two flipped frames are flipped too."""
    flipped = np.zeros(len(previous), bool)
    t, state = end
    while t >= 0:
        earlier, earlier_state = previous[t, state]
        if state:
            flipped[earlier + 1 if compared[t, state] and earlier_state else t : t + 1] = True
        t, state = earlier, earlier_state
    return flipped


def _exchange(
    observations: Observations, pairs: Int[np.ndarray, "P 2"], flipped: Bool[np.ndarray, "N T P"]
) -> Observations:
    """Exchange the two keypoints of each flipped pair."""
    changed = {}
    for name in ("keypoints_px", "confidence", "occluded"):
        array = cast(np.ndarray, getattr(observations, name)).copy()
        when = flipped.reshape(*flipped.shape, *[1] * (array.ndim - 3))
        left, right = array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]]
        array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]] = np.where(when, right, left), np.where(when, left, right)
        changed[name] = array
    return replace(observations, **changed)
