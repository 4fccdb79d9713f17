"""Detection metrics that ignore identities: average precision, and the accuracy of keypoints."""

from __future__ import annotations

import contextlib
import io
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Int
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from jaxfit.data.observations import Observations
from jaxfit.evaluation import metrics
from jaxfit.evaluation.overlap import Overlap, assign, ignored_region, region

__all__ = ["KeypointRow", "average_precision", "keypoint_accuracy", "matches"]


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
            values += [metrics.pck(own[:, k], observed[:, k], counted[:, k], side, p, "pooled") for p in (0.05, 0.10)]
        return KeypointRow(*values)

    rows = {name: row(slice(k, k + 1)) for k, name in enumerate(names)}
    return rows | {"all": row(slice(None))} if names else {}
