"""Overlap of detected and true birds, and detection metrics that ignore identities."""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from scipy.optimize import linear_sum_assignment

from jaxfit.data.masks import box_iou, box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.evaluation import metrics
from jaxfit.evaluation.truth import MIN_KEYPOINTS, Truth
from jaxfit.foundation.errors import InputError

MATCH_IOU = 0.5
"""Least IoU at which a detected bird matches a true bird."""
MIN_VISIBLE = 0.05
"""Ground-truth birds with a smaller visible fraction of the usual area of their track are ignored."""
LARGEST_ROUNDING_PX = 1.0
"""Largest difference between the box of a bird's keypoints and the box in a file of labels."""
_REMEDY = "give the annotations of the same video"


class Overlap(NamedTuple):
    """M true and N detected birds in the L frames that the truth and the observations share."""

    true_frame: Int[np.ndarray, "L"]
    """Positions of the shared frames in the truth."""
    detected_frame: Int[np.ndarray, "L"]
    """Positions of the shared frames in the observations."""
    true: Bool[np.ndarray, "L M"]
    """True birds that count."""
    ignored: Bool[np.ndarray, "L M"]
    """True birds that are present but hardly visible: neither a detection nor a miss of them counts."""
    detected: Bool[np.ndarray, "L N"]
    """Detected birds that count."""
    excused: Bool[np.ndarray, "L N"]
    """Detected birds that match no true bird but lie on an ignored bird: they are no false alarms and do not count."""
    iou: Float[np.ndarray, "L M N"]
    """Intersection over union of the birds that count; 0 elsewhere."""
    kind: Literal["masks", "boxes"]
    """The regions of the IoU."""


def overlap(detected: Observations, truth: Truth | Observations) -> Overlap:
    """Compare the detected birds of a video with the true birds.

    The regions are visible masks where both files have masks, else boxes. In a truth with masks, a bird is ignored
    where its visible mask is smaller than ``MIN_VISIBLE`` times the median area of the whole masks of its track (of
    the visible masks where no whole masks are known), or where the mask is missing: hidden birds, slivers at the edge
    of the image, crowds. A detected bird that matches no counted bird is excused where at least ``MATCH_IOU`` of its
    area lies on an ignored bird. The region of an ignored bird is its visible mask, or its box where there is no mask
    and the bird is not known to be hidden.

    Args:
        detected: observations of N tracks.
        truth: annotations of M tracks.

    Raises:
        InputError: no common frame, frames of different sizes, or photographs instead of video.

    Source: ignored birds correspond to the crowds of COCO (Lin et al. 2014, *Microsoft COCO*), which are matched by
    the intersection over the area of the detection, after all counted birds; and to the distractors of MOT16 (Milan
    et al. 2016).
    """
    truth = Truth.of(truth)
    seen, source = truth.observations, truth.source
    for observations, name in ((seen, source), (detected, "the observations")):
        if observations.own_images:
            raise InputError(name, "hold several images of one frame: photographs", "give annotations of one video")
    _, at_truth, at_detected = np.intersect1d(seen.frame_index, detected.frame_index, return_indices=True)
    if not len(at_truth):
        raise InputError(source, "shares no frame with the observations", _REMEDY)
    sizes = seen.image_size_px[at_truth], detected.image_size_px[at_detected]
    if (sizes[0] != sizes[1]).any():
        t = int(np.flatnonzero((sizes[0] != sizes[1]).any(1))[0])
        (w, h), (own_w, own_h) = sizes[0][t], sizes[1][t]
        problem = f"has frame {seen.frame_index[at_truth[t]]} of {w}×{h} pixels, the observations of {own_w}×{own_h}"
        raise InputError(source, problem, _REMEDY)
    masks = bool(seen.masks) and (bool(detected.masks) or not detected.present.any())
    present, hidden = seen.present[:, at_truth].T, _hidden(seen)[:, at_truth].T
    true, counted = present & ~hidden, detected.present[:, at_detected].T.copy()
    excused = np.zeros(counted.shape, bool)
    iou = np.zeros((len(at_truth), seen.num_tracks, detected.num_tracks))
    for i, (t, s) in enumerate(zip(at_truth.tolist(), at_detected.tolist(), strict=True)):
        rows, columns = np.flatnonzero(true[i]).tolist(), np.flatnonzero(counted[i]).tolist()
        own = [region(detected, n, s, masks) for n in columns]
        iou[i][np.ix_(rows, columns)] = _iou(own, [region(seen, m, t, masks) for m in rows]).T
        ignored = [ignored_region(seen, m, t, masks) for m in np.flatnonzero(present[i] & hidden[i]).tolist()]
        covered = (_iou(own, [rle for rle in ignored if rle is not None], of_own=True) >= MATCH_IOU).any(1)
        covered = covered & ~np.isin(columns, assign(iou[i])[1])
        excused[i, np.array(columns, int)[covered]] = True
    iou = np.where(excused[:, None], 0.0, iou)
    kind = "masks" if masks else "boxes"
    return Overlap(at_truth, at_detected, true, present & hidden, counted & ~excused, excused, iou, kind)


def comparable_boxes(detected: Observations, truth: Truth) -> tuple[Observations, Truth]:
    """Return both with boxes around the same keypoints, where labelled birds have boxes of keypoints and no masks.

    Labels of keypoint programs have the box of the visible keypoints, which is smaller than the box of the mask of the
    detected bird. Such a labelled bird gets the box of its labelled keypoints that the detections name, at least
    ``MIN_KEYPOINTS``. A detected bird gets the box of the same keypoints of the labelled bird that it agrees with
    best. All other boxes stay, and so do boxes that a person drew.
    """
    seen = truth.observations
    names = [name for name in seen.keypoint_names if name in detected.keypoint_names]
    if seen.masks or len(names) < MIN_KEYPOINTS:
        return detected, truth
    _, at, own_at = np.intersect1d(seen.frame_index, detected.frame_index, return_indices=True)
    k, own_k = ([each.keypoint_names.index(name) for name in names] for each in (seen, detected))
    labelled = seen.confidence > 0
    known = labelled[:, :, k]
    is_own = np.isclose(seen.box_px, box_of_keypoints(seen.keypoints_px, labelled), atol=LARGEST_ROUNDING_PX).all(-1)
    is_own &= known.sum(-1) >= MIN_KEYPOINTS
    if not is_own.any():
        return detected, truth
    box_px = np.where(is_own[..., None], box_of_keypoints(seen.keypoints_px[:, :, k], known), seen.box_px)
    own_box_px = detected.box_px.copy()
    for n in range(detected.num_tracks):
        both = known[:, at] & (detected.confidence[n, own_at][:, own_k] > 0)
        points_px = np.broadcast_to(detected.keypoints_px[n, own_at][:, own_k], (*both.shape, 2))
        boxes_px = box_of_keypoints(points_px, both)
        iou = np.nan_to_num(box_iou(boxes_px, box_px[:, at])) * is_own[:, at]
        best = iou.argmax(0), np.arange(len(at))
        own_box_px[n, own_at] = np.where(iou[best][:, None] > 0, boxes_px[best], own_box_px[n, own_at])
    return replace(detected, box_px=own_box_px), replace(truth, observations=replace(seen, box_px=box_px))


def assign(
    similarity: Float[np.ndarray, "M N"], at_least: float = MATCH_IOU
) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """Return one-to-one pairs with the greatest sum of similarities, each at least ``at_least`` (which is above 0)."""
    close = np.where(similarity >= at_least, similarity, 0.0)
    rows, columns = linear_sum_assignment(close, maximize=True)
    matched = close[rows, columns] > 0
    return rows[matched], columns[matched]


def region(observations: Observations, n: int, t: int, masks: bool = True) -> dict[str, Any]:
    """Return the run lengths of a bird's mask; of its box where there is no mask, or ``masks`` is False."""
    rle = observations.masks.get((n, t)) if masks else None
    if rle is None:
        width, height = observations.image_size(n, t)
        box = observations.box_px[n, t].astype(np.float64)[None]
        return cast(Any, coco_mask.frPyObjects(cast(Any, box), height, width))[0]
    return cast(Any, rle)


def ignored_region(truth: Observations, m: int, t: int, masks: bool) -> dict[str, Any] | None:
    """Return the region in which an ignored bird excuses detections; None where the bird is wholly hidden."""
    known_hidden = (m, t) not in truth.masks and (m, t) in truth.amodal_masks
    return None if known_hidden else region(truth, m, t, masks)


def _hidden(truth: Observations) -> Bool[np.ndarray, "M T"]:
    """Return where the visible fraction of a bird is below ``MIN_VISIBLE``, also where the bird is not annotated."""
    if not truth.masks:
        return np.zeros(truth.present.shape, bool)
    visible, whole = np.zeros(truth.present.shape), np.zeros(truth.present.shape)
    for at, rle in truth.masks.items():
        visible[at] = whole[at] = coco_mask.area(cast(Any, rle))
    for at, rle in truth.amodal_masks.items():
        whole[at] = coco_mask.area(cast(Any, rle))
    usual = [np.median(areas[areas > 0]) if areas.any() else np.inf for areas in whole]
    return visible < MIN_VISIBLE * np.array(usual)[:, None]


def _iou(own: list, others: list, of_own: bool = False) -> Float[np.ndarray, "D G"]:
    """Return the intersection over the union of regions, or over the area of ``own``."""
    if not own or not others:
        return np.zeros((len(own), len(others)))
    return np.asarray(coco_mask.iou(own, others, [int(of_own)] * len(others)), np.float64)


def matches(overlap: Overlap) -> Int[np.ndarray, "P 3"]:
    """Return the matching pairs: frame (position along L), true bird, detected bird.

    Birds match one-to-one from an IoU of ``MATCH_IOU`` on, with the greatest sum of IoUs in each frame.
    """
    rows = [(i, m, n) for i, iou in enumerate(overlap.iou) for m, n in zip(*assign(iou), strict=True)]
    return np.array(rows, int).reshape(-1, 3)


def average_precision(detected: Observations, truth: Observations, overlap: Overlap) -> tuple[float, float]:
    """Return AP50 and AP50-95: the mean precision over 101 recalls, at an IoU of 0.5 and over 0.50, 0.55, …, 0.95.

    Detections are ranked by score. Birds of all sizes and any number of birds in a frame count. NaN without a true
    bird.

    Args:
        detected: observations with scores.
        truth: annotations.
        overlap: of the two, which says which birds are ignored.

    Source: Lin et al. 2014, *Microsoft COCO*, detection evaluation; computed by pycocotools.
    """
    if not overlap.true.any():
        return float("nan"), float("nan")
    masks = overlap.kind == "masks"
    true, own = [], []
    for i, (t, s) in enumerate(zip(overlap.true_frame.tolist(), overlap.detected_frame.tolist(), strict=True)):
        shape = {"image_id": i, "category_id": 1}
        for m in np.flatnonzero(overlap.true[i]).tolist():
            true.append(shape | {"iscrowd": 0, "segmentation": region(truth, m, t, masks)})
        ignored = (ignored_region(truth, m, t, masks) for m in np.flatnonzero(overlap.ignored[i]).tolist())
        true += [shape | {"iscrowd": 1, "segmentation": rle} for rle in ignored if rle is not None]
        for n in np.flatnonzero(detected.present[:, s]).tolist():
            score = float(cast(np.ndarray, detected.score)[n, s])
            own.append(shape | {"iscrowd": 0, "segmentation": region(detected, n, s, masks), "score": score})
    sizes = truth.image_size_px[overlap.true_frame].tolist()
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints, and has no option against it
        evaluation = COCOeval(_coco(true, sizes), _coco(own, sizes), "segm")
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0, np.inf]], ["all"]
        evaluation.params.maxDets = [max(1, detected.num_tracks)]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, 0, 0, 0]  # IoU, recall, category, area, most detections
    return float(precision[0].mean()), float(precision.mean())


def _coco(annotations: list[dict[str, Any]], sizes: list[list[int]]) -> COCO:
    """Return annotations as pycocotools takes them; sizes are width and height of each image."""
    coco: Any = COCO()
    coco.dataset = {
        "images": [{"id": i, "width": width, "height": height} for i, (width, height) in enumerate(sizes)],
        "categories": [{"id": 1}],
        "annotations": [
            # ids start at 1: pycocotools takes the id 0 of a match for "no match"
            {"id": i, "area": float(coco_mask.area(a["segmentation"]))} | a
            for i, a in enumerate(annotations, 1)
        ],
    }
    coco.createIndex()
    return coco


class KeypointRow(NamedTuple):
    """PCK of one keypoint, or of all: fractions within 5 and 10 % of the bird's size; NaN without a keypoint."""

    visible: int
    """Number of annotated keypoints that are not hidden."""
    pck_05: float
    """Of the visible keypoints."""
    pck_10: float
    annotated: int
    """Number of annotated keypoints, hidden ones included."""
    annotated_pck_05: float
    """Of the annotated keypoints."""
    annotated_pck_10: float


def keypoint_accuracy(
    detected: Observations, truth: Observations, overlap: Overlap, pairs: Int[np.ndarray, "P 3"]
) -> dict[str, KeypointRow]:
    """Return the PCK of the matched birds by keypoint, and of all keypoints together as ``all``.

    Only keypoints that both files name are compared. A keypoint that is not detected (confidence 0) is wrong. The size
    of a bird is the longer side of its annotated box, which in simulated truth includes the hidden parts of the bird.

    Args:
        detected: observations.
        truth: annotations.
        overlap: of the two.
        pairs: the result of ``matches``.

    Returns:
        Keypoint → row, in the order of the truth; empty where the files share no keypoint.
    """
    names = [name for name in truth.keypoint_names if name in detected.keypoint_names]
    i, m, n = pairs.T
    t, s = overlap.true_frame[i], overlap.detected_frame[i]
    k_true, k_detected = ([seen.keypoint_names.index(name) for name in names] for seen in (truth, detected))
    # index birds and frames first, then keypoints: the result is (P, K, …)
    observed, annotated = truth.keypoints_px[m, t][:, k_true], truth.confidence[m, t][:, k_true] > 0
    visible = annotated & ~cast(np.ndarray, truth.occluded)[m, t][:, k_true]
    known = detected.confidence[n, s][:, k_detected] > 0
    own = np.where(known[..., None], detected.keypoints_px[n, s][:, k_detected], np.nan)
    side = truth.box_px[m, t, 2:].max(-1)

    def row(k: slice) -> KeypointRow:
        values = []
        for counted in (visible, annotated):
            values.append(int(counted[:, k].sum()))
            for share in (0.05, 0.10):
                correct = metrics.correct_keypoints(own[:, k], observed[:, k], counted[:, k], side, share)
                values.append(metrics.mean_error(correct))
        return KeypointRow(*values)

    rows = {name: row(slice(k, k + 1)) for k, name in enumerate(names)}
    return rows | {"all": row(slice(None))} if names else {}
