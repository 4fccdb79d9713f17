"""A pose prior learnt from results: mean and covariance of the poses that birds were found in.

Frames of one bird are much alike, so that a thousand of them tell far less than a thousand birds would. The covariance
is therefore shrunk by the number of poses that would tell as much if each came by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.model.bird import Bird

__all__ = ["LearntPrior", "effective_count", "learn_prior", "oas_shrinkage"]

LEAST_SD_RAD = 0.02
"""A component that hardly moved in these results is still given this much room."""
LEAST_BONE_SD = 0.01
"""The same of a bone's relative length."""


@dataclass(frozen=True, eq=False)
class LearntPrior:
    """A bird with a prior learnt from results, and what that rests on."""

    bird: Bird
    poses: int
    birds: int
    diverged: int
    """Birds left out because their fit diverged."""
    effective_poses: float
    """How many poses that have nothing to do with each other tell as much."""
    shrinkage: float
    """From 0, the correlations as they were counted, to 1, none."""
    bones_learnt: bool
    """Whether bone lengths differed between birds; else their prior is the model's."""
    mean_change_rad: Float[np.ndarray, "bones"]
    """How far each joint's mean moved from the model's: length of the change of its axis-angle."""


def learn_prior(results: Sequence[tuple[object, Solution, Bird]]) -> LearntPrior:
    """The model of some results, with a pose prior learnt from them.

    Mean and variances are those of all valid poses of birds whose fit did not diverge. Correlations are shrunk towards
    none: C ← (1 − ρ) C + ρ I with the ρ of `oas_shrinkage` at the `effective_count` of poses, and no standard
    deviation is below 0.02 rad, so that the covariance is positive definite however few there are. Bone lengths are
    learnt likewise, one sample a bird, where they differ between birds.

    The results' own prior is in them: what is learnt lies nearer to it, and is narrower, than what birds do. Fit with
    a small weight of `pose_prior` to learn from.

    Args:
        results: each with its name for errors, its poses and the model it was fitted with.

    Raises:
        InputError: results of models with other joints, or no valid pose.
    """
    first_source, _, bird = results[0]
    tracks, bones, diverged = [], [], 0
    for source, solution, own in results:
        if (own.name, own.joint_names) != (bird.name, bird.joint_names):
            problem = f"is of the model {own.name}, but {first_source} of {bird.name}, or its joints differ"
            raise InputError(source, problem, "learn from results of one model")
        for n, status in enumerate(solution.status):
            valid = solution.valid[n]
            diverged += status == "diverged"
            if valid.any():
                pose = solution.body_pose[n].astype(np.float64)
                tracks.append((pose.reshape(len(valid), -1), valid))
                bones.append(solution.bone_length[n, valid].mean(axis=0, dtype=np.float64))
    if not tracks:
        left = f"; {diverged} diverged" if diverged else ""
        raise InputError(first_source, f"holds no pose to learn from{left}", "give results with fitted birds")
    poses = np.concatenate([pose[valid] for pose, valid in tracks])
    effective = effective_count(tracks)
    mean, covariance, shrinkage = _gaussian(poses, effective, LEAST_SD_RAD)
    learnt = replace(
        bird, pose_mean=jnp.asarray(mean, jnp.float32), pose_covariance=jnp.asarray(covariance, jnp.float32)
    )
    bones_learnt = bool(np.ptp(np.array(bones), axis=0).max() > 1e-4)
    if bones_learnt:
        bone_mean, bone_covariance, _ = _gaussian(np.array(bones), len(bones), LEAST_BONE_SD)
        learnt = replace(
            learnt,
            bone_mean=jnp.asarray(bone_mean, jnp.float32),
            bone_covariance=jnp.asarray(bone_covariance, jnp.float32),
        )
    change = (mean - np.asarray(bird.pose_mean, np.float64)).reshape(-1, 3)
    moved = np.linalg.norm(change, axis=1)
    return LearntPrior(learnt, len(poses), len(tracks), diverged, effective, shrinkage, bones_learnt, moved)


def effective_count(tracks: Sequence[tuple[Float[np.ndarray, "T D"], Bool[np.ndarray, "T"]]]) -> float:
    """How many independent poses tell as much as all valid frames: n (1 − r)/(1 + r), but at least one a track.

    r is the correlation of consecutive valid frames, over all tracks and components of standardised poses: a track
    is taken for an autoregressive process of order 1.

    Args:
        tracks: poses of each, and which of them are valid.

    Source: Bayley and Hammersley 1946, *The "Effective" Number of Independent Observations in an Autocorrelated Time
    Series*.
    """
    poses = np.concatenate([pose[valid] for pose, valid in tracks])
    spread = np.maximum(poses.std(axis=0), 1e-9)
    together = apart = 0.0
    neighbours = 0
    for pose, valid in tracks:
        pairs = valid[:-1] & valid[1:]
        before, after = ((pose[at][pairs] - poses.mean(axis=0)) / spread for at in (slice(-1), slice(1, None)))
        together += (before * after).sum()
        apart += ((before**2 + after**2) / 2).sum()
        neighbours += pairs.sum()
    # birds that do not move at all are as alike as can be; frames without a neighbour are taken for independent
    r = np.clip(together / apart, 0.0, 1.0) if apart else float(neighbours > 0)
    return max(float(len(poses) * (1 - r) / (1 + r)), float(len(tracks)))


def oas_shrinkage(matrix: Float[np.ndarray, "D D"], count: float) -> float:
    """How far to shrink a sample covariance S of `count` samples towards (tr S/D) I, by oracle approximation.

    ρ = min(1, ((1 − 2/D) tr S² + tr² S) / ((n + 1 − 2/D) (tr S² − tr² S/D))).

    Source: Chen, Wiesel, Eldar and Hero 2010, *Shrinkage Algorithms for MMSE Covariance Estimation*, eq. 23.
    """
    size, trace, squared = len(matrix), float(np.trace(matrix)), float((matrix**2).sum())
    above = (1 - 2 / size) * squared + trace**2
    below = (count + 1 - 2 / size) * (squared - trace**2 / size)
    return min(1.0, above / below) if below > 0 and math.isfinite(below) else 1.0


def _gaussian(
    samples: Float[np.ndarray, "n D"], count: float, least_sd: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"], float]:
    """Mean, covariance with shrunk correlations, and the shrinkage."""
    mean = samples.mean(axis=0)
    deviation = samples - mean
    sd = np.sqrt((deviation**2).mean(axis=0) + least_sd**2)
    # the floor is noise of every component's own, which correlates with nothing
    correlation = (deviation / sd).T @ (deviation / sd) / len(samples)
    np.fill_diagonal(correlation, 1.0)
    shrinkage = oas_shrinkage(correlation, count)
    shrunk = (1 - shrinkage) * correlation + shrinkage * np.eye(len(mean))
    return mean, sd[:, None] * shrunk * sd, shrinkage
