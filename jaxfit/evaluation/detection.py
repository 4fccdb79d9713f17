"""How well birds and their keypoints are found, whoever they are."""

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

__all__ = ["KeypointRow", "average_precision", "found_keypoints", "matches"]


def matches(overlap: Overlap) -> Int[np.ndarray, "P 3"]:
    """Frame (along L), true and found bird of every pair that matches: from an IoU of ``MATCHED``, one-to-one, with
    the greatest sum of IoUs."""
    rows = [(i, m, n) for i, iou in enumerate(overlap.iou) for m, n in zip(*assign(iou), strict=True)]
    return np.array(rows, int).reshape(-1, 3)


def average_precision(found: Observations, truth: Observations, overlap: Overlap) -> tuple[float, float]:
    """AP50 and AP50-95: mean precision over 101 recalls, at an IoU of 0.5, and over 0.50, 0.55, …, 0.95.

    Ranked by score; birds of all sizes, and as many a frame as there are. Without a true bird NaN.

    Args:
        found: observations with scores.
        truth: annotations.
        overlap: of the two; ignored birds are its.

    Source: Lin et al. 2014, *Microsoft COCO*, detection evaluation; computed by pycocotools.
    """
    if not overlap.true.any():
        return float("nan"), float("nan")
    masks = overlap.kind == "masks"
    true, own = [], []
    for i, (t, s) in enumerate(zip(overlap.true_frame.tolist(), overlap.found_frame.tolist(), strict=True)):
        shape = {"image_id": i, "category_id": 1}
        for m in np.flatnonzero(overlap.true[i]).tolist():
            true.append(shape | {"iscrowd": 0, "segmentation": region(truth, m, t, masks)})
        vague = (ignored_region(truth, m, t, masks) for m in np.flatnonzero(overlap.ignored[i]).tolist())
        true += [shape | {"iscrowd": 1, "segmentation": rle} for rle in vague if rle is not None]
        for n in np.flatnonzero(found.present[:, s]).tolist():
            score = float(cast(np.ndarray, found.score)[n, s])
            own.append(shape | {"iscrowd": 0, "segmentation": region(found, n, s, masks), "score": score})
    sizes = truth.image_size_px[overlap.true_frame].tolist()
    with contextlib.redirect_stdout(io.StringIO()):  # it has no other way to be silent
        judge = COCOeval(_coco(true, sizes), _coco(own, sizes), "segm")
        judge.params.areaRng, judge.params.areaRngLbl = [[0, np.inf]], ["all"]
        judge.params.maxDets = [max(1, found.num_tracks)]
        judge.evaluate()
        judge.accumulate()
    precision = judge.eval["precision"][:, :, 0, 0, 0]  # IoU, recall, category, area, most a frame
    return float(precision[0].mean()), float(precision.mean())


def _coco(annotations: list[dict[str, Any]], sizes: list[list[int]]) -> COCO:
    coco: Any = COCO()
    coco.dataset = {
        "images": [{"id": i, "width": width, "height": height} for i, (width, height) in enumerate(sizes)],
        "categories": [{"id": 1}],
        "annotations": [
            # counted from 1: pycocotools takes a match with id 0 for none
            {"id": i, "area": float(coco_mask.area(a["segmentation"]))} | a
            for i, a in enumerate(annotations, 1)
        ],
    }
    coco.createIndex()
    return coco


class KeypointRow(NamedTuple):
    """Shares of the keypoints of one name, or of all, within 5 and 10 % of the bird's size; NaN where there is none."""

    visible: int
    """How many annotated ones nothing hides."""
    pck_05: float
    pck_10: float
    annotated: int
    """How many there are, hidden ones included."""
    annotated_pck_05: float
    annotated_pck_10: float


def found_keypoints(
    found: Observations, truth: Observations, overlap: Overlap, pairs: Int[np.ndarray, "P 3"]
) -> dict[str, KeypointRow]:
    """PCK of the matched birds' keypoints, by name, and of all together as ``all``.

    Keypoints that only one of the two files names are left out; one that is not found (confidence 0) is wrong. A bird's
    size is the longer side of its annotated box, which in simulated truth is the whole bird's, hidden parts included.

    Args:
        found: observations.
        truth: annotations.
        overlap: of the two.
        pairs: as ``matches`` gives them.

    Returns:
        Rows in the truth's order; empty where the files share no name.
    """
    names = [name for name in truth.keypoint_names if name in found.keypoint_names]
    i, m, n = pairs.T
    t, s = overlap.true_frame[i], overlap.found_frame[i]
    k_true, k_found = ([seen.keypoint_names.index(name) for name in names] for seen in (truth, found))
    # frames and birds first, then keypoints: (P, K, …)
    observed, annotated = truth.keypoints_px[m, t][:, k_true], truth.confidence[m, t][:, k_true] > 0
    visible = annotated & ~cast(np.ndarray, truth.occluded)[m, t][:, k_true]
    there = found.confidence[n, s][:, k_found] > 0
    own = np.where(there[..., None], found.keypoints_px[n, s][:, k_found], np.nan)
    side = truth.box_px[m, t, 2:].max(-1)

    def row(k: slice) -> KeypointRow:
        figures = []
        for counted in (visible, annotated):
            figures.append(int(counted[:, k].sum()))
            figures += [metrics.pck(own[:, k], observed[:, k], counted[:, k], side, p, "pooled") for p in (0.05, 0.10)]
        return KeypointRow(*figures)

    rows = {name: row(slice(k, k + 1)) for k, name in enumerate(names)}
    return rows | {"all": row(slice(None))} if names else {}
