"""Individuals: bodies that differ from the mean bird of a model, and keypoints that lie beside those of the model.

A fit that knows only the mean bird errs with individuals. A scene in which all birds have the bones of the model does
not show this error.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit.model.bird import Bird, rest_length

BONE_SD = 0.05
"""Standard deviation of the length of each bone between individuals, as a share of the mean length."""
OFFSET = 0.02
"""Mean distance between the keypoints of an annotator or a network and those of the model, as a share of the body
length."""
PRIOR_SPREAD = 0.7
"""Deviations from the mean, in standard deviations of the priors of a model, as for the body pose."""


def draw_bones(bird: Bird, rng: np.random.Generator, sd: float = BONE_SD) -> Float[np.ndarray, "bones"]:
    """Draw the bone lengths of an individual: independent normal shares of the mean lengths.

    Left and right bones have the same share.

    Args:
        bird: the model.
        rng: source of randomness.
        sd: standard deviation of each length, as a share of the mean length; 0 gives the mean lengths.
    """
    share = _mirrored(bird, 1 + sd * rng.standard_normal(bird.num_joints - 1))
    return (np.asarray(bird.bone_mean) * share).astype(np.float32)


def draw_bones_of_prior(
    bird: Bird, rng: np.random.Generator, spread: float = PRIOR_SPREAD
) -> Float[np.ndarray, "bones"]:
    """Draw the bone lengths of an individual from the prior of a model.

    Left and right bones have the same share of the mean length, between 0.5 and 1.8.

    Args:
        bird: the model.
        rng: source of randomness.
        spread: factor of the deviations from the mean.
    """
    mean = np.asarray(bird.bone_mean, np.float64)
    share = _mirrored(bird, draw_normal(rng, mean, bird.bone_covariance, spread) / mean)
    return (mean * np.clip(share, 0.5, 1.8)).astype(np.float32)


def draw_shape(bird: Bird, rng: np.random.Generator, spread: float = PRIOR_SPREAD) -> Float[np.ndarray, "S"]:
    """Draw the shape coefficients of an individual, with `spread` standard deviations of the shape space."""
    variance = np.asarray(bird.shape_variance, np.float64)
    return (spread * np.sqrt(variance) * rng.standard_normal(len(variance))).astype(np.float32)


def draw_offsets(bird: Bird, rng: np.random.Generator, mean: float = OFFSET) -> Float[np.ndarray, "K 3"]:
    """Draw the constant offsets of the keypoints of an annotator or a network, in the rest pose, model units.

    The distances are uniform between 0.5 and 1.5 times the mean, in random directions, the same on both sides of the
    bird. A keypoint without a counterpart stays in the plane of symmetry.

    Args:
        bird: the model, with the keypoints bill_tip and tail_tip.
        rng: source of randomness.
        mean: mean distance, as a share of the body length.
    """
    direction = rng.standard_normal((bird.num_keypoints, 3))
    paired = {k for pair in bird.keypoint_pairs for k in pair}
    direction[[k for k in range(len(direction)) if k not in paired], 0] = 0  # x is lateral
    offsets = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    offsets *= rest_length(bird) * rng.uniform(0.5 * mean, 1.5 * mean, (len(offsets), 1))
    for left, right in bird.keypoint_pairs:
        offsets[right] = offsets[left] * [-1, 1, 1]
    return offsets


def _mirrored(bird: Bird, share: Float[np.ndarray, "bones"]) -> Float[np.ndarray, "bones"]:
    """Return values of the bones, with those of the left side on both sides."""
    for left, right in bird.bone_pairs:
        share[right] = share[left]
    return share


def draw_normal(rng: np.random.Generator, mean: Any, covariance: Any, spread: float = 1.0) -> Float[np.ndarray, "D"]:
    """Draw from a normal distribution whose deviations are multiplied by `spread`.

    `Generator.multivariate_normal` decomposes into singular vectors. A covariance with equal eigenvalues has many such
    decompositions, and the rounding of the processor selects one. The Cholesky factor is unique.
    """
    factor = np.linalg.cholesky(np.asarray(covariance, np.float64))
    return np.asarray(mean) + spread * factor @ rng.standard_normal(len(factor))
