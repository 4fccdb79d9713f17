"""Which birds of a video cover which: found ones against true ones, frame by frame, by mask or box."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int
from pycocotools import mask as coco_mask
from scipy.optimize import linear_sum_assignment

from jaxfit.data.observations import Observations
from jaxfit.errors import InputError

__all__ = ["HIDDEN", "MATCHED", "Overlap", "assign", "ignored_region", "overlap", "region"]

MATCHED = 0.5
"""IoU from which on a found bird is the true one."""
HIDDEN = 0.05
"""A true bird of which less than this is to be seen is asked of nobody, as a share of its track's usual area."""
_REMEDY = "give the annotations of the same video"


class Overlap(NamedTuple):
    """M true and N found birds in the L frames that both files hold."""

    true_frame: Int[np.ndarray, "L"]
    """Positions of the frames in the truth."""
    found_frame: Int[np.ndarray, "L"]
    """Their positions among the observations."""
    true: Bool[np.ndarray, "L M"]
    """True birds that count."""
    ignored: Bool[np.ndarray, "L M"]
    """True birds that are there but hardly to be seen: finding them is no error, and neither is missing them."""
    found: Bool[np.ndarray, "L N"]
    """Found birds that count."""
    excused: Bool[np.ndarray, "L N"]
    """Found birds that are no false alarm although they match none: they lie on an ignored bird."""
    iou: Float[np.ndarray, "L M N"]
    """Intersection over union of those that count; 0 elsewhere."""
    kind: Literal["masks", "boxes"]
    """What is compared."""


def overlap(found: Observations, truth: Observations, source: object = "truth") -> Overlap:
    """Compare what was found in a video with what was there.

    Visible masks are compared where both files hold masks, else boxes. In a truth with masks a bird is ignored
    where its visible mask is under ``HIDDEN`` of the median area of its track's whole masks (of its visible ones
    where no whole ones are known), or missing: hidden birds, slivers at the edge of the picture, crowds. A found bird
    that matches no counted one is excused where at least ``MATCHED`` of its own area lies on an ignored one (its
    visible mask; the box where there is no mask and the bird may not be hidden).

    Args:
        found: observations of N tracks.
        truth: annotations of M tracks.
        source: what the truth was read from, for messages.

    Raises:
        InputError: no frame in common, frames of another size, or photographs instead of video.

    Source: ignored birds are what COCO calls crowds (Lin et al. 2014, *Microsoft COCO*; matched by the intersection
    over the area of the found one, and after all counted birds), and MOT16 distractors (Milan et al. 2016).
    """
    for seen, name in ((truth, source), (found, "the observations")):
        if seen.own_images:
            raise InputError(name, "hold several images of one frame: photographs", "give annotations of one video")
    _, at_truth, at_found = np.intersect1d(truth.frame_index, found.frame_index, return_indices=True)
    if not len(at_truth):
        raise InputError(source, "shares no frame with the observations", _REMEDY)
    sizes = truth.image_size_px[at_truth], found.image_size_px[at_found]
    if (sizes[0] != sizes[1]).any():
        t = int(np.flatnonzero((sizes[0] != sizes[1]).any(1))[0])
        (w, h), (own_w, own_h) = sizes[0][t], sizes[1][t]
        problem = f"has frame {truth.frame_index[at_truth[t]]} of {w}×{h} pixels, the observations of {own_w}×{own_h}"
        raise InputError(source, problem, _REMEDY)
    masks = bool(truth.masks) and (bool(found.masks) or not found.present.any())
    there, hidden = truth.present[:, at_truth].T, _hidden(truth)[:, at_truth].T
    true, judged = there & ~hidden, found.present[:, at_found].T.copy()
    excused = np.zeros(judged.shape, bool)
    iou = np.zeros((len(at_truth), truth.num_tracks, found.num_tracks))
    for i, (t, s) in enumerate(zip(at_truth.tolist(), at_found.tolist(), strict=True)):
        rows, columns = np.flatnonzero(true[i]).tolist(), np.flatnonzero(judged[i]).tolist()
        own = [region(found, n, s, masks) for n in columns]
        iou[i][np.ix_(rows, columns)] = _iou(own, [region(truth, m, t, masks) for m in rows]).T
        vague = [ignored_region(truth, m, t, masks) for m in np.flatnonzero(there[i] & hidden[i]).tolist()]
        covered = (_iou(own, [v for v in vague if v is not None], of_own=True) >= MATCHED).any(1)
        covered = covered & ~np.isin(columns, assign(iou[i])[1])
        excused[i, np.array(columns, int)[covered]] = True
    iou = np.where(excused[:, None], 0.0, iou)
    kind = "masks" if masks else "boxes"
    return Overlap(at_truth, at_found, true, there & hidden, judged & ~excused, excused, iou, kind)


def assign(
    similarity: Float[np.ndarray, "M N"], at_least: float = MATCHED
) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """Pairs, one-to-one, with the greatest sum of similarities, none of them below ``at_least`` (above 0)."""
    close = np.where(similarity >= at_least, similarity, 0.0)
    rows, columns = linear_sum_assignment(close, maximize=True)
    matched = close[rows, columns] > 0
    return rows[matched], columns[matched]


def region(observations: Observations, n: int, t: int, masks: bool = True) -> dict[str, Any]:
    """Run lengths of a bird's mask; of its box where there is none, or ``masks`` is False."""
    rle = observations.masks.get((n, t)) if masks else None
    if rle is None:
        width, height = observations.image_size(n, t)
        box = observations.box_px[n, t].astype(np.float64)[None]
        return cast(Any, coco_mask.frPyObjects(cast(Any, box), height, width))[0]
    return cast(Any, rle)


def ignored_region(truth: Observations, m: int, t: int, masks: bool) -> dict[str, Any] | None:
    """Where an ignored bird excuses what is found there; None where all of it is hidden."""
    known_hidden = (m, t) not in truth.masks and (m, t) in truth.amodal_masks
    return None if known_hidden else region(truth, m, t, masks)


def _hidden(truth: Observations) -> Bool[np.ndarray, "M T"]:
    """Where there is too little of a bird to ask for it; its annotation may lack altogether."""
    if not truth.masks:
        return np.zeros(truth.present.shape, bool)
    visible, whole = np.zeros(truth.present.shape), np.zeros(truth.present.shape)
    for at, rle in truth.masks.items():
        visible[at] = whole[at] = coco_mask.area(cast(Any, rle))
    for at, rle in truth.amodal_masks.items():
        whole[at] = coco_mask.area(cast(Any, rle))
    usual = [np.median(areas[areas > 0]) if areas.any() else np.inf for areas in whole]
    return visible < HIDDEN * np.array(usual)[:, None]


def _iou(own: list, others: list, of_own: bool = False) -> Float[np.ndarray, "D G"]:
    """Intersection over union, or over the area of ``own``."""
    if not own or not others:
        return np.zeros((len(own), len(others)))
    return np.asarray(coco_mask.iou(own, others, [int(of_own)] * len(others)), np.float64)
