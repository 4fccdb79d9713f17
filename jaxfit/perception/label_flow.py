"""Keypoints of few labelled frames, carried to all frames of their birds by optical flow.

Between two frames of a bird, dense inverse search gives the flow in a crop around the bird, forward and backward. Flow
outside the mask is replaced by the flow of the nearest pixel of the mask, so that points on the outline move with the
bird and not with the background.

A point is carried from its label to later and to earlier frames, step by step. Between two labels of a keypoint, the
carried points a from the label before and b from the label after are combined as a Brownian bridge: with the number of
steps i from the label before, and m to the label after, the position is a + i/(i + m)·(b − a), and the variance of each
coordinate q·i·m/(i + m). The distance d by which a carried point misses the next label gives q = d²/2 per interval, in
units of its steps. Beyond the last label of a keypoint, the variance grows as q̄·i, with the median q̄ of all
keypoints. The errors of the round trips of single steps are added to the variance.

Source: Kroeger et al. 2016, *Fast Optical Flow using Dense Inverse Search*; the bridge is ours.
"""

from __future__ import annotations

import logging
from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt

from jaxfit.data.formats.mask_files import assign_masks
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.keypoint_names import map_keypoints, names_in_model
from jaxfit.data.masks import box_of_rle, decode_mask
from jaxfit.data.observations import FROM_FLOW, FROM_LABEL, FROM_OUTLINE, Observations
from jaxfit.data.tracks import positions_in
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.video.reader import read_frames

_logger = logging.getLogger(__name__)

BIRD_PX = 256
"""Longer side of a bird in the pictures of which the flow is computed."""
GRID_PX = 4
"""Distance of the stored vectors of the flow in these pictures."""
MARGIN = 0.25
"""Margin of the crop around a bird, as a share of the longer side of its box."""
SURE_SD, LARGEST_SD = 0.02, 0.1
"""Standard deviation of a label, which has confidence 1, and of a carried keypoint of confidence 0, as shares of the
length of the bird: the longer side of its box. Confidences between are those of `keypoint_sd_px`."""
STEP_SD = 0.004
"""Least standard deviation of one step of the flow, as a share of the length: one pixel of `BIRD_PX`."""
OUTSIDE = 0.05
"""A carried keypoint farther from the mask than this share of the length is left out."""
MAX_GAP = 10
"""Frames of a track without a mask, over which the flow is still computed."""
CONTRADICTED = 0.1
"""Labels contradict each other if the carried keypoints of one miss those of the other by more than this share of the
length, in the median."""


class CarriedLabels(NamedTuple):
    """Observations with the keypoints of labels."""

    observations: Observations
    """`keypoint_origin` says which frames have labels, carried keypoints, or none."""
    used: int
    """Number of labelled birds that are used."""
    problems: tuple[str, ...]
    """Labels that are left out or contradict each other, and why."""


class _Step(NamedTuple):
    """The flow of a bird between two frames of its track."""

    corners_px: Float[np.ndarray, "2 2"]
    """Corner of the crop in each of the frames, image pixels."""
    zoom: float
    """Pixels of the crop per image pixel."""
    flow: tuple[np.ndarray, np.ndarray]
    """(G, G, 2) each: forward and backward, in pixels of the crop."""
    length_px: float
    """Longer side of the box of the bird, image pixels."""

    def carry(self, points_px: Float[np.ndarray, "K 2"], backward: bool = False) -> Float[np.ndarray, "K 2"]:
        """Return where points of the first frame are in the second frame, or the reverse; image pixels."""
        first, second = self.corners_px[::-1] if backward else self.corners_px
        at = (points_px - first) * self.zoom
        maps = ((at - 0.5) / GRID_PX).astype(np.float32)[None]  # the stored vectors are those of every fourth pixel
        grid = self.flow[int(backward)].astype(np.float32)
        moved = cv2.remap(grid, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
        return second + (at + moved) / self.zoom


def read_few_labels(file: str | Path, video: Path, names: Sequence[str]) -> Observations:
    """Read the labels of some frames of a video, with the keypoints of a model.

    Args:
        file: labels in any format of `read_observations`.
        video: the video, or folder of frames.
        names: keypoints of the model.

    Raises:
        InputError: the file cannot be read, is not of this video, or has too few keypoints of the model.
    """
    labels = read_observations(file, video, untracked="labels")
    return map_keypoints(labels, names_in_model(labels.keypoint_names, names, file), names)


def carry_labels(
    observations: Observations,
    labels: Observations,
    video: str | Path,
    source: object = "labels",
    progress: ProgressTask = silent,
) -> CarriedLabels:
    """Return the observations with the keypoints of labels, carried to all frames by flow, in place of their own.

    Keypoints from the outline remain where no label is carried to.

    A labelled bird belongs to the track whose mask covers its keypoints. A label that contradicts its neighbours, which
    agree with each other, is left out.

    Args:
        observations: tracks with masks.
        labels: labelled birds in some frames of the same video; their tracks do not matter. The keypoints have the
            names of the observations, in the same order.
        video: the video, or folder of frames.
        source: the file of the labels, for messages.
        progress: shows the frames.

    Raises:
        InputError: no label belongs to a track.
    """
    problems: list[str] = []
    tracks = _labels_of_tracks(observations, labels, problems)
    if not tracks:
        reason = problems[0] if problems else "the file has no labelled bird"
        problem = f"no label belongs to a tracked bird: {reason}"
        raise InputError(
            source, problem, "compare the frame numbers of the labels with the video, and look at its masks"
        )
    points = np.zeros_like(observations.keypoints_px)
    confidence = np.zeros_like(observations.confidence)
    origin = np.zeros(observations.present.shape, np.int8)
    used = 0
    for n, steps in _flows(observations, sorted(tracks), video, progress).items():
        carried = _Track(steps, *_of_track(tracks[n], labels), _lengths(observations, n))
        names = {t: f"frame {observations.frame_index[t]}" for t in tracks[n]}
        for t in carried.remove_contradicted():
            problems.append(f"{names[t]}: the label contradicts the labels before and after it, so it is left out")
        for (a, b), share in carried.contradictions().items():
            problems.append(
                f"{names[a]} and {names[b]}: the flow carries the labels {share:.0%} of the length apart; look at "
                "both, or label a frame between them"
            )
        used += len(carried.at)
        points[n], confidence[n] = carried.keypoints()
        _leave_out_outside(observations, n, points[n], confidence[n])
        origin[n] = np.where(confidence[n].any(-1), FROM_FLOW, 0)
        origin[n, carried.at] = FROM_LABEL
    confidence[~observations.present] = 0
    for problem in problems:
        _logger.warning("%s: %s", source, problem)
    by_outline = np.asarray(observations.keypoint_origin) == FROM_OUTLINE
    own = by_outline & ~confidence.any(-1)
    # keypoints that no label is carried to; a person leaves out what cannot be seen
    missing = (by_outline & (origin != FROM_LABEL))[..., None] & (confidence == 0)
    confidence = np.where(missing, observations.confidence, confidence)
    points = np.where(missing[..., None], observations.keypoints_px, points)
    origin = np.where(own, FROM_OUTLINE, np.where(observations.present, origin, 0))
    points = np.where(confidence[..., None] > 0, points, 0)
    changed = replace(observations, occluded=None, keypoint_origin=origin)
    return CarriedLabels(changed.with_keypoints(points, confidence), used, tuple(problems))


def _labels_of_tracks(
    observations: Observations, labels: Observations, problems: list[str]
) -> dict[int, dict[int, tuple[int, int]]]:
    """Return track → frame → bird and frame of its label, as positions; append the labels of no track to `problems`."""
    found: dict[int, dict[int, tuple[int, int]]] = {}
    columns = positions_in(labels.frame_index, observations.frame_index)
    known = (labels.confidence > 0).any(-1) & labels.present
    for s in np.flatnonzero(known.any(0)).tolist():
        t, birds, number = int(columns[s]), np.flatnonzero(known[:, s]).tolist(), labels.frame_index[s]
        if t < 0:
            last = observations.frame_index[-1] if observations.num_frames else 0
            problems.append(f"frame {number} is not in the tracked frames ({observations.frame_index[0]} to {last})")
            continue
        seen = [n for n in np.flatnonzero(observations.present[:, t]).tolist() if (n, t) in observations.masks]
        size = tuple(labels.image_size_px[s].tolist()), tuple(observations.image_size_px[t].tolist())
        if size[0] != size[1]:
            sizes = " and ".join(f"{width}×{height}" for width, height in size)
            problems.append(f"frame {number}: the sizes of the pictures of labels and video differ: {sizes}")
            continue
        masks = [decode_mask(observations.masks[n, t]) for n in seen]
        pairs = dict(assign_masks(labels, birds, s, masks))
        for b in birds:
            if b in pairs:
                found.setdefault(seen[pairs[b]], {})[t] = (b, s)
            else:
                problems.append(f"frame {number}: no mask covers the keypoints of a labelled bird")
    return found


def _of_track(cells: Mapping[int, tuple[int, int]], labels: Observations) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return frames, positions (L, K, 2), and whether a keypoint is labelled (L, K), of the labels of a track."""
    at = sorted(cells)
    rows, columns = (np.array([cells[t][i] for t in at]) for i in (0, 1))
    return at, labels.keypoints_px[rows, columns].astype(np.float64), labels.confidence[rows, columns] > 0


def _lengths(observations: Observations, n: int) -> Float[np.ndarray, "T"]:
    """Return the length of a bird in every frame: the longer side of its box; the median in frames without the bird."""
    length = observations.box_px[n, :, 2:].max(-1).astype(np.float64)
    return np.where(length > 0, length, np.median(length[length > 0]))


def _flows(
    observations: Observations, tracks: list[int], video: str | Path, progress: ProgressTask
) -> dict[int, dict[int, tuple[int, _Step]]]:
    """Return track → position of a frame → position of the next frame with the bird, and the flow between the two."""
    found: dict[int, dict[int, tuple[int, _Step]]] = {n: {} for n in tracks}
    earlier: dict[int, tuple[int, np.ndarray]] = {}
    has_mask = {
        n: {t for t in np.flatnonzero(observations.present[n]).tolist() if (n, t) in observations.masks} for n in tracks
    }
    wanted = sorted(set().union(*has_mask.values()))
    numbers = observations.frame_index
    with progress("Following the labels", len(wanted)) as report_progress:
        for t, grey in _grey_frames(video, numbers, wanted):
            for n in tracks:
                if t not in has_mask[n]:
                    continue
                before = earlier.get(n)
                if before is not None and t - before[0] <= MAX_GAP + 1:
                    masks = [observations.masks[n, s] for s in (before[0], t)]
                    step = _step((before[1], grey), masks)
                    if step is not None:
                        found[n][before[0]] = t, step
                earlier[n] = t, grey
            report_progress(1, "")
    return found


def _grey_frames(
    video: str | Path, numbers: Int[np.ndarray, "T"], wanted: list[int]
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W"]]]:
    """Yield position and grey picture of the wanted frames, in the order of time."""
    position = {int(numbers[t]): t for t in wanted}
    if not position:
        return
    for frame in read_frames(video, min(position), max(position) + 1):
        if frame.index in position:
            yield position[frame.index], cv2.cvtColor(frame.picture, cv2.COLOR_BGR2GRAY)


def _step(pictures: tuple[np.ndarray, np.ndarray], masks: list[Mapping[str, Any]]) -> _Step | None:
    """Return the flow of a bird between two grey pictures; None if a mask is empty."""
    boxes = [box_of_rle(mask) for mask in masks]
    if boxes[0] is None or boxes[1] is None:
        return None
    box = np.array(boxes, np.float64)
    length = float(box[:, 2:].max())
    side = length * (1 + 2 * MARGIN)
    corners = np.round(box[:, :2] + box[:, 2:] / 2 - side / 2)  # whole pixels, so that a bird at rest has no flow
    zoom = BIRD_PX / length
    pixels = round(side * zoom)
    cuts = [_cut(picture, corner, zoom, pixels) for picture, corner in zip(pictures, corners, strict=True)]
    inside = [_cut(decode_mask(m).view(np.uint8), c, zoom, pixels) for m, c in zip(masks, corners, strict=True)]
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grids = []
    for first, second in ((0, 1), (1, 0)):
        dense = flow.calc(cuts[first], cuts[second], None)
        grids.append(_with_outside(dense, inside[first] > 0)[::GRID_PX, ::GRID_PX].astype(np.float16))
    return _Step(corners, zoom, (grids[0], grids[1]), length)


def _cut(picture: np.ndarray, corner: np.ndarray, zoom: float, pixels: int) -> np.ndarray:
    """Return a square of a picture, resampled; the border of the picture continues beyond it."""
    # pixel centres: x_crop + ½ = zoom·(x + ½ − corner)
    shift = zoom * (0.5 - corner) - 0.5
    matrix = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]])
    shrunk = zoom < 1
    if shrunk:  # an area average, as bilinear samples would skip pixels
        picture = cv2.blur(picture, (round(1 / zoom),) * 2)
    return cv2.warpAffine(picture, matrix, (pixels, pixels), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _with_outside(flow: Float[np.ndarray, "H W 2"], inside: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 2"]:
    """Return a flow with the vector of the nearest pixel inside the mask at every pixel outside."""
    core = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8))  # flow mixes over the outline
    if not core.any():
        return flow
    nearest: Any = distance_transform_edt(core == 0, return_distances=False, return_indices=True)
    row, column = nearest
    return flow[row, column]


class _Track:
    """The labels of one track, carried to its frames.

    Args:
        steps: frame → next frame and the flow between the two.
        at: frames of the labels, in the order of time.
        points_px: (L, K, 2) positions of the labels.
        known: (L, K) whether a keypoint is labelled.
        length_px: (T,) length of the bird.
    """

    def __init__(
        self,
        steps: Mapping[int, tuple[int, _Step]],
        at: list[int],
        points_px: Float[np.ndarray, "L K 2"],
        known: Bool[np.ndarray, "L K"],
        length_px: Float[np.ndarray, "T"],
    ):
        self.at, self._points_px, self._known, self._length_px = at, points_px, known, length_px
        self._next = steps
        self._before = {t: (s, step) for s, (t, step) in steps.items()}
        self._carried = {i: self._carry(i) for i in range(len(at))}

    def _carry(self, label: int) -> dict[int, tuple[int, np.ndarray, np.ndarray]]:
        """Return frame → number of steps, positions (K, 2) and variances (K,) of the keypoints of a label."""
        found = {}
        for backward, steps in ((False, self._next), (True, self._before)):
            t, points = self.at[label], self._points_px[label]
            variance, count = np.zeros(len(points)), 0
            while t in steps:
                after, step = steps[t]
                moved = step.carry(points, backward)
                round_trip = np.linalg.norm(step.carry(moved, not backward) - points, axis=-1) / step.length_px
                t, points, count = after, moved, count + abs(after - t)
                variance = variance + round_trip**2 / 2
                found[t] = count, points, variance
        return found

    def _distance(self, i: int, j: int) -> float:
        """Return the median distance of the carried keypoints of two labels, as a share of the length.

        NaN without a common keypoint, or if the flow is interrupted between the labels.
        """
        both = self._known[i] & self._known[j]
        shares = []
        for a, b in ((i, j), (j, i)):
            if self.at[b] not in self._carried[a] or not both.any():
                return np.nan
            _, points, _ = self._carried[a][self.at[b]]
            error = np.linalg.norm(points - self._points_px[b], axis=-1)[both] / self._length_px[self.at[b]]
            shares.append(np.median(error))
        return float(np.mean(shares))

    def remove_contradicted(self) -> list[int]:
        """Remove the labels that contradict the labels before and after, which agree; return their frames.

        If these two agree, the flow is right between them. Without a label on both sides, the flow may be wrong.
        """
        removed = []
        while len(self.at) > 2:
            inner = range(1, len(self.at) - 1)
            apart = {i: min(self._distance(i - 1, i), self._distance(i, i + 1)) for i in inner}
            wrong = [i for i in inner if apart[i] > max(CONTRADICTED, 2 * self._distance(i - 1, i + 1))]  # not for NaN
            if not wrong:
                break
            worst = max(wrong, key=apart.__getitem__)
            removed.append(self.at.pop(worst))
            self._points_px, self._known = (np.delete(x, worst, axis=0) for x in (self._points_px, self._known))
            self._carried.pop(worst)
            self._carried = dict(enumerate(self._carried.values()))
        return sorted(removed)

    def contradictions(self) -> dict[tuple[int, int], float]:
        """Return the frames of two consecutive labels that contradict each other → their distance."""
        apart = {(self.at[i], self.at[i + 1]): self._distance(i, i + 1) for i in range(len(self.at) - 1)}
        return {pair: share for pair, share in apart.items() if share > CONTRADICTED}

    def keypoints(self) -> tuple[Float[np.ndarray, "T K 2"], Float[np.ndarray, "T K"]]:
        """Return positions in image pixels and confidences of all keypoints in all frames."""
        T, K = len(self._length_px), self._points_px.shape[1]
        points_px, variance = np.zeros((T, K, 2)), np.full((T, K), np.inf)
        rates = self._rates()
        known_rates = [rate for rate in rates.values() if np.isfinite(rate)]
        common = max(float(np.median(known_rates)) if known_rates else 0.0, STEP_SD**2)
        for t in range(T):
            for k in range(K):
                if t not in self.at:
                    points_px[t, k], variance[t, k] = self._combined(t, k, rates, common)
        points_px[self.at], variance[self.at] = self._points_px, np.where(self._known, 0, np.inf)
        sd = np.sqrt(SURE_SD**2 + variance)
        confidence = np.log(sd / LARGEST_SD) / np.log(SURE_SD / LARGEST_SD)
        return points_px.astype(np.float32), np.maximum(confidence, 0).astype(np.float32)

    def _rates(self) -> dict[tuple[int, int], float]:
        """Return (label, keypoint) → q of the interval to the next label, in squared shares of the length per frame."""
        rates = {}
        for i in range(len(self.at) - 1):
            end = self.at[i + 1]
            if end not in self._carried[i]:
                continue
            count, points, _ = self._carried[i][end]
            error = np.linalg.norm(points - self._points_px[i + 1], axis=-1) / self._length_px[end]
            for k in np.flatnonzero(self._known[i] & self._known[i + 1]).tolist():
                rates[i, k] = float(error[k] ** 2 / 2 / max(count, 1))
        return rates

    def _combined(
        self, t: int, k: int, rates: Mapping[tuple[int, int], float], common: float
    ) -> tuple[np.ndarray, float]:
        """Return position and variance of a keypoint in a frame without label; the variance is infinite if unknown.

        A keypoint that the nearer of the two labels lacks is hidden.
        """
        last = bisect(self.at, t) - 1
        nearest = [i for i in (last, last + 1) if 0 <= i < len(self.at) and t in self._carried[i]]
        nearest.sort(key=lambda i: abs(self.at[i] - t))
        if not nearest or not self._known[nearest[0], k]:
            return np.zeros(2), np.inf
        reached = [self._carried[i][t] for i in sorted(nearest) if self._known[i, k]]
        if len(reached) == 1:
            ((count, points, trips),) = reached
            return points[k], common * count + trips[k]
        (before, a, trips_a), (after, b, trips_b) = reached
        share = before / (before + after)
        trips = (1 - share) ** 2 * trips_a[k] + share**2 * trips_b[k]
        rate = max(rates.get((last, k), common), STEP_SD**2)
        return a[k] + share * (b[k] - a[k]), rate * before * after / (before + after) + trips


def _leave_out_outside(
    observations: Observations, n: int, points_px: Float[np.ndarray, "T K 2"], confidence: Float[np.ndarray, "T K"]
) -> None:
    """Set the confidence of keypoints far outside the mask of their bird to 0."""
    for t in np.flatnonzero(confidence.any(-1)).tolist():
        if (n, t) not in observations.masks:
            confidence[t] = 0
            continue
        mask = decode_mask(observations.masks[n, t])
        distance = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 5)
        column, row = np.clip(np.floor(points_px[t]).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        length = float(observations.box_px[n, t, 2:].max())
        confidence[t, (distance[row, column] > OUTSIDE * length) & (confidence[t] < 1)] = 0


def origin_counts(observations: Observations) -> dict[int, dict[str, int]]:
    """Return track → what the poses of frames stand on → number of frames."""
    present, origin = observations.present, np.asarray(observations.keypoint_origin)
    alone = present & ((origin == FROM_OUTLINE) | ~observations.confidence.any(-1))
    kinds = {"labels": origin == FROM_LABEL, "flow": origin == FROM_FLOW, "the outline alone": alone}
    return {
        track: {kind: int(where[n].sum()) for kind, where in kinds.items()}
        for n, track in enumerate(observations.track_id.tolist())
    }
