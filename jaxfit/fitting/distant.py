"""Birds far outside their image: damaged detections, which a fit skips and reports."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from jaxfit.data.observations import Observations
from jaxfit.limits import DISTANCE_IMAGE_SIDES

__all__ = ["distant_birds", "report_distant_birds", "without_distant_birds"]

_logger = logging.getLogger(__name__)

_LISTED_FRAMES = 10
_PROBLEM = f"a box or a keypoint lies more than {DISTANCE_IMAGE_SIDES:g} × the image's longer side outside the image"


def distant_birds(observations: Observations) -> Bool[np.ndarray, "N T"]:
    """Return where the box or a keypoint of a bird is far outside its image.

    The distance is measured in x and in y, from the nearest edge of the image. It is far if it exceeds
    `limits.DISTANCE_IMAGE_SIDES` times the longer side of the image. Missing keypoints do not count.
    """
    size_px = observations.image_size_px
    if observations.own_images:
        size_px = np.broadcast_to(size_px, (*observations.present.shape, 2)).copy()
        for at, (_, width, height) in observations.own_images.items():
            size_px[at] = width, height
    allowed_px = DISTANCE_IMAGE_SIDES * size_px.max(-1, keepdims=True)
    corner_px, extent_px = (observations.box_px[..., axes].astype(np.float64) for axes in (slice(2), slice(2, 4)))
    keypoints = (observations.keypoints_px[:, :, k] for k in range(observations.num_keypoints))  # (0, 0) if missing
    distant = np.zeros(observations.present.shape, bool)
    for points_px in (corner_px, corner_px + extent_px, *keypoints):
        distant |= ((points_px < -allowed_px) | (points_px > size_px + allowed_px)).any(-1)
    return distant & observations.present


def without_distant_birds(observations: Observations) -> Observations:
    """Return the observations without the birds of `distant_birds`, each in the frames in which it is distant."""
    distant = distant_birds(observations)
    if not distant.any():
        return observations
    confidence = np.where(distant[..., None], np.float32(0), observations.confidence)
    return replace(observations, present=observations.present & ~distant, confidence=confidence)


def report_distant_birds(observations: Observations, source: object) -> dict[int, tuple[str, ...]]:
    """Return track → text about its frames with a distant bird, as `Solution.failures`, and log one warning.

    Args:
        observations: the observations.
        source: name of the observations in the warning.
    """
    distant = distant_birds(observations)
    reports = {}
    for n in np.flatnonzero(distant.any(1)).tolist():
        frames = observations.frame_index[distant[n]].tolist()
        listed = ", ".join(map(str, frames[:_LISTED_FRAMES]))
        more = f" and {len(frames) - _LISTED_FRAMES} more" if len(frames) > _LISTED_FRAMES else ""
        text = f"{'frame' if len(frames) == 1 else 'frames'} {listed}{more} skipped: {_PROBLEM}"
        reports[int(observations.track_id[n])] = (text,)
    if reports:
        track, (text,) = next(iter(reports.items()))
        others = len(reports) - 1
        more = f" (and {others} more {'track' if others == 1 else 'tracks'})" if others else ""
        _logger.warning("%s: track %d, %s%s", source, track, text, more)
    return reports
