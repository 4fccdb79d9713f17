"""Offsets between the keypoints of the observations and the keypoints of the model.

A person or a network marks a keypoint beside the point of the model: another part of the nape, the tip of the longest
tail feather in place of the middle of the tail. In the rest pose, the difference is constant. For given poses, the
posterior of the offset o of a keypoint is Gaussian:

    H = Σ w·JᵀJ/s² + I/τ²,   o = H⁻¹ · Σ w·Jᵀe/s²,

with the errors e of the keypoint without its offset, the derivative J of the projected keypoint by the offset, the
scale s and the weights w = (ν + 2)/(ν + ‖e − J·o‖²/s²) of `keypoint_likelihood`, and the prior N(0, τ²·I). The sum is
over the frames of a sample. A keypoint and its mirror image have mirrored offsets, and a keypoint in the middle of the
bird has no offset to the side. τ is learnt, too: τ² = Σ‖o‖²/γ, with the number of determined offsets
γ = Σ (3 − tr(H⁻¹)/τ²).

Source: MacKay 1992, *Bayesian interpolation* (γ and τ); Lange, Little and Taylor 1989, *Robust statistical modeling
using the t distribution* (w). The model of offsets is ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxfit.config.yaml_file import rounded
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.kinematics import Pose, Rig, move_keypoints, window_keypoints, window_transforms
from jaxfit.objective.likelihood import keypoint_sd_px
from jaxfit.objective.posed_window import Targets

PRIOR_SHARE = 0.03
"""First standard deviation τ of an offset, as a share of the largest distance between keypoints at rest."""
PRIOR_COUNT = 10.0
"""The first τ counts as so many numbers of offsets in the update of τ."""
_MIRROR = np.array([-1.0, 1.0, 1.0])
"""In all models, x points sideways."""


class Offsets(NamedTuple):
    """Learnt offsets of the keypoints."""

    offsets: Float[np.ndarray, "K 3"]
    """In the rest pose, model units."""
    prior_sd: float
    """τ, model units."""

    def by_name(self, bird: Bird) -> dict[str, tuple[float, ...]]:
        """Return `FitConfig.keypoint_offsets`, rounded to three digits."""
        rows = [tuple(float(rounded(number)) for number in row) for row in self.offsets.tolist()]
        return dict(zip(bird.keypoint_names, rows, strict=True))


def longest_distance(bird: Bird) -> float:
    """Return the largest distance between keypoints at rest, model units."""
    rest = np.asarray(bird.keypoints, np.float64)
    return float(np.linalg.norm(rest[:, None] - rest, axis=-1).max())


def first_offsets(bird: Bird, given: Mapping[str, Sequence[float]]) -> Offsets:
    """Return the offsets before learning: those of the config, else 0."""
    offsets = np.array([given.get(name, (0.0, 0.0, 0.0)) for name in bird.keypoint_names], np.float64)
    return Offsets(offsets, PRIOR_SHARE * longest_distance(bird))


def offset_directions(bird: Bird) -> Float[np.ndarray, "D K 3"]:
    """Return the free directions of the offsets.

    A keypoint and its mirror image have mirrored offsets. All keypoints together do not move, turn or grow, because the
    place, the orientation and the size of a bird are free.
    """
    pairs, directions = [*bird.keypoint_pairs], []
    paired = {k for pair in pairs for k in pair}
    for k, other in [*pairs, *((k, k) for k in range(bird.num_keypoints) if k not in paired)]:
        for axis in range(3) if other != k else (1, 2):
            direction = np.zeros((bird.num_keypoints, 3))
            direction[other, axis], direction[k, axis] = _MIRROR[axis], 1
            directions.append(direction)
    rest, free = np.asarray(bird.keypoints, np.float64), np.array(directions)
    _, y, z = (rest - rest.mean(0)).T
    zero, one = np.zeros_like(y), np.ones_like(y)
    moves = (zero, one, zero), (zero, zero, one), (zero, -z, y), (rest - rest.mean(0)).T  # turn about the lateral axis
    of_moves = [[(np.transpose(move) * direction).sum() for direction in free] for move in moves]
    return np.tensordot(scipy.linalg.null_space(np.array(of_moves)).T, free, axes=1)


def learn_offsets(
    bird: Bird,
    rig: Rig,
    camera: CropCamera,
    before: Offsets,
    pose: Pose,
    targets: Targets,
    scale: Mapping[str, float],
) -> Offsets:
    """Return the offsets of the keypoints for the poses of W windows.

    Args:
        bird, rig, camera: of the fit; the rig has the offsets `before`.
        before: the offsets with which the poses were fitted.
        pose: the poses.
        targets: the observations. Keypoints of confidence 0 do not count.
        scale: settings of `keypoint_likelihood`.
    """
    keypoints_px, J = (np.asarray(each, np.float64) for each in _keypoints_and_slopes(rig, camera, pose))
    confidence = np.where(targets.present[..., None], targets.confidence, 0)
    seen = confidence > 0
    variance = keypoint_sd_px(confidence, scale["sd_sure_px"], scale["sd_unsure_px"]) ** 2
    # frames without the bird have arbitrary poses
    J, error = np.where(seen[..., None, None], J, 0), np.where(seen[..., None], targets.keypoints_px - keypoints_px, 0)
    weight = seen * (scale["dof"] + 2) / (scale["dof"] + (error**2).sum(-1) / variance) / variance
    # e was measured with the offsets before: linear in the offset, the error without them is e + J·o_before
    error = error + np.einsum("wtkac,kc->wtka", J, before.offsets)
    H = np.einsum("wtk,wtkab,wtkac->kbc", weight, J, J)
    slope = np.einsum("wtk,wtkac,wtka->kc", weight, J, error)
    return _posterior(bird, H, slope, before.prior_sd)


def _posterior(bird: Bird, H: Float[np.ndarray, "K 3 3"], slope: Float[np.ndarray, "K 3"], prior_sd: float) -> Offsets:
    """Return the mean of the posterior, and the next τ."""
    pairs = [*bird.keypoint_pairs]
    paired = {k for pair in pairs for k in pair}
    offsets, squared, determined = np.zeros_like(slope), 0.0, 0.0
    for k, other in [*pairs, *((k, k) for k in range(len(slope)) if k not in paired)]:
        # a keypoint in the middle is its own mirror image, and counts twice with half its weight
        both, sum_of_both = H[k] + H[other] * np.outer(_MIRROR, _MIRROR), slope[k] + slope[other] * _MIRROR
        used = np.arange(3) if other != k else np.array([1, 2])
        half = 1.0 if other != k else 0.5
        # a pair shares one offset o, mirrored by M = diag(−1, 1, 1): H_pair = H_k + M·H_other·M, and the slopes alike
        covariance = np.linalg.inv(half * both[np.ix_(used, used)] + np.eye(len(used)) / prior_sd**2)
        offset = np.zeros(3)
        offset[used] = covariance @ (half * sum_of_both[used])
        offsets[k], offsets[other] = offset, offset * (_MIRROR if other != k else 1)
        squared += float(offset @ offset)
        determined += len(used) - float(np.trace(covariance)) / prior_sd**2
    # γ counts the numbers that the data determine: each has 1 − Σ_ii/τ², and τ² = Σ‖o‖²/γ with the hyperprior
    variance = (squared + PRIOR_COUNT * prior_sd**2) / (determined + PRIOR_COUNT)
    return Offsets(offsets, float(np.sqrt(variance)))


@eqx.filter_jit
def _keypoints_and_slopes(
    rig: Rig, camera: CropCamera, pose: Pose
) -> tuple[Float[Array, "W T K 2"], Float[Array, "W T K 2 3"]]:
    """Return the projected keypoints, and the derivative of each keypoint by its offset."""

    def keypoints_px(offsets: Float[Array, "K 3"]) -> Float[Array, "W T K 2"]:
        moved = move_keypoints(rig, offsets)
        points_cam = jax.vmap(lambda each: window_keypoints(moved, window_transforms(moved, each), each))(pose)
        return project(points_cam, camera)

    zero = jnp.zeros((rig.keypoint_map.shape[0], 3))
    # a keypoint depends on its own offset only, so that one direction serves all keypoints
    directions = [jnp.broadcast_to(unit, zero.shape) for unit in jnp.eye(3)]
    slopes = [jax.jvp(keypoints_px, (zero,), (direction,))[1] for direction in directions]
    return keypoints_px(zero), jnp.stack(slopes, axis=-1)
