"""The similarity that takes the keypoints of a model to those of a scan, and the detection of mirrored scans."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["Similarity", "fit_similarity", "is_mirrored", "robust_similarity"]

MIRROR_RATIO = 0.88
"""A scan counts as mirrored if the mirrored keypoints fit with at most this share of the error. Of 80
simulated birds in random poses with 12 keypoints, at most 2 count as mirrored by mistake."""


class Similarity(NamedTuple):
    """x → scale · R x + shift."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Return the moved points."""
        return self.scale * points @ self.R.T + self.shift

    def invert(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Return the points before the move."""
        return (points - self.shift) @ self.R / self.scale


def fit_similarity(
    source: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    weight: Float[np.ndarray, "P"] | None = None,
    mirrored: bool = False,
) -> Similarity:
    """Return the similarity with the smallest weighted sum of squared distances.

    Args:
        source: points before the move.
        target: points after the move.
        weight: weights of the points; None for equal weights.
        mirrored: R is a rotation and a reflection, instead of a rotation.

    Source: Umeyama 1991, *Least-Squares Estimation of Transformation Parameters Between Two Point Patterns*.
    """
    weight = np.ones(len(source)) if weight is None else weight
    share = (weight / weight.sum())[:, None]
    centre, target_centre = (share * source).sum(0), (share * target).sum(0)
    a, b = source - centre, target - target_centre
    U, singular, Vt = np.linalg.svd((share * b).T @ a)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1 if mirrored else 1)
    signs = np.array([1, 1, sign if sign else 1])
    R = (U * signs) @ Vt
    scale = float((singular * signs).sum() / max((share * a**2).sum(), 1e-300))
    return Similarity(scale, R, target_centre - scale * R @ centre)


def robust_similarity(
    source: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    mirrored: bool = False,
    up: Float[np.ndarray, "3"] | None = None,
) -> tuple[Similarity, float]:
    """Return a similarity that single wrong points hardly change, and its error as a share of the target's size.

    Args:
        source: keypoints of a model, whose upward direction is +z.
        target: keypoints of a scan.
        mirrored: as for `fit_similarity`.
        up: upward direction of the scan, a unit vector. It counts as two further points, above and below the centre.
    """
    size = _size(target)
    if up is not None:
        above, own = up * size, np.array([0, 0, _size(source)])
        source = np.concatenate([source, source.mean(0) + np.stack([own, -own])])
        target = np.concatenate([target, target.mean(0) + np.stack([above, -above])])
    weight = np.ones(len(source))
    for _ in range(10):
        found = fit_similarity(source, target, weight, mirrored)
        error = np.linalg.norm(found.apply(source) - target, axis=1) / max(size, 1e-300)
        weight = 1 / (1 + (error / 0.3) ** 2) ** 2
    robust = np.sqrt((error**2 / (1 + (error / 0.3) ** 2)).mean())
    return found, float(robust)


def _size(points: Float[np.ndarray, "P 3"]) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def is_mirrored(source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"]) -> bool:
    """Return whether the mirrored keypoints fit clearly better: the scan is mirrored, or left and right are exchanged.

    Keypoints in one plane fit equally well in both ways, and then the result is False.
    """
    proper, reflected = (robust_similarity(source, target, mirrored)[1] for mirrored in (False, True))
    return reflected < MIRROR_RATIO * proper
