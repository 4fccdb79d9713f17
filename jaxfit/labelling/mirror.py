"""Disagreement under flips: a keypoint network sees the mirror image of a bird and should detect the same keypoints."""

from __future__ import annotations

from typing import cast

import numpy as np
from jaxtyping import UInt8

from jaxfit.data.observations import Observations
from jaxfit.labelling.signals import LARGEST_SHARE
from jaxfit.model.anatomy import mirror_pairs
from jaxfit.perception.instances import Instance, KeypointDetector, instance_of

__all__ = ["mirror_disagreement"]


def mirror_disagreement(
    picture: UInt8[np.ndarray, "H W 3"], observations: Observations, t: int, detector: KeypointDetector
) -> float:
    """Return the mean distance between the keypoints of a frame and the keypoints that a network detects mirrored.

    The network sees the mirrored picture with mirrored masks. The detected positions are mirrored back, and left and
    right keypoints are exchanged. Distances are shares of the longer side of the box, at most `LARGEST_SHARE`.

    Args:
        picture: the frame.
        observations: birds; a bird without a mask has its box as mask.
        t: position of the frame.
        detector: a network with the keypoint names of the observations, in any order.

    Returns:
        Mean over all keypoints with a confidence above 0 of all birds; NaN without such a keypoint.
    """
    width = picture.shape[1]
    rows, birds = [], []
    for n in np.flatnonzero(observations.present[:, t]).tolist():
        bird = _instance(observations, n, t)
        if bird is not None:
            rows.append(n)
            x0 = width - bird.x0 - bird.mask.shape[1]
            birds.append(bird._replace(mask=np.ascontiguousarray(bird.mask[:, ::-1]), x0=x0))
    if not birds:
        return float("nan")
    points, _ = detector(np.ascontiguousarray(picture[:, ::-1]), birds)
    points = np.stack([width - points[..., 0], points[..., 1]], axis=-1)
    names = detector.keypoint_names
    other = np.arange(len(names))
    for left, right in mirror_pairs(names):
        other[[left, right]] = right, left
    order = [names.index(name) for name in observations.keypoint_names]
    points = points[:, other][:, order]
    side = observations.box_px[rows, t, 2:].max(-1)[:, None]
    share = np.minimum(np.linalg.norm(points - observations.keypoints_px[rows, t], axis=-1) / side, LARGEST_SHARE)
    known = observations.confidence[rows, t] > 0
    return float(share[known].mean()) if known.any() else float("nan")


def _instance(observations: Observations, n: int, t: int) -> Instance | None:
    """Return the bird as a segmenter would report the bird; None if the bird lies outside the picture."""
    score = float(cast(np.ndarray, observations.score)[n, t])
    mask = observations.mask(n, t)
    if mask is not None:
        return instance_of(mask, score, "bird")
    size = np.array(observations.image_size(n, t))
    low, extent = np.split(observations.box_px[n, t], 2)
    first, last = np.clip(np.floor(low), 0, size).astype(int), np.clip(np.ceil(low + extent), 0, size).astype(int)
    if (last <= first).any():
        return None
    width, height = (last - first).tolist()
    return Instance(np.ones((height, width), bool), int(first[0]), int(first[1]), score, "bird")
