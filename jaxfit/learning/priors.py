"""A prior of poses from fitted results.

The frames of one bird are correlated, so 1000 frames contain much less information than 1000 birds. The shrinkage of
the covariance therefore depends on the effective number of poses: the number of independent poses with the same
information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.solution import Solution
from jaxfit.data.tracks import consecutive
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.objective.posed_window import priors_of

MIN_SD_RAD = 0.02
"""Smallest standard deviation of a component of the pose, for components that hardly move in the results."""
MIN_WIDTH = 1e-3
"""Smallest width of a prior, for results whose poses are all the model's mean."""
MIN_BONE_SD = 0.01
"""Smallest standard deviation of a bone's relative length."""


@dataclass(frozen=True, eq=False)
class LearntPrior:
    """A bird model with a learnt prior, and the amount of data behind the prior."""

    bird: Bird
    """The model of the results, with the learnt prior."""
    poses: int
    """Number of valid poses."""
    birds: int
    """Number of birds with a valid pose."""
    diverged: int
    """Number of skipped birds: all windows of the bird diverged. A bird with status `partly diverged` contributes its
    valid poses."""
    effective_poses: float
    """Number of independent poses with the same information, see `effective_count`."""
    shrinkage: float
    """Factor ρ between 0 (the sample correlations) and 1 (no correlations)."""
    bones_learnt: bool
    """Whether the prior of bone lengths is learnt. If all birds have equal bone lengths, the model's prior is kept."""
    mean_change_rad: Float[np.ndarray, "bones"]
    """Norm of the difference between the learnt and the model's mean axis-angle of each joint, in radians."""
    width: float
    """Factor on the covariance of the model with which the poses are most likely: their mean squared Mahalanobis
    distance from the model's mean, per component."""

    @property
    def pose_prior_weight(self) -> float:
        """Weight of `pose_prior` that is the negative log-density of that covariance, in nats."""
        return 0.5 / self.width


def learn_prior(results: Sequence[tuple[object, Solution, Bird]]) -> LearntPrior:
    """Learn a pose prior from results, and return the model with the learnt prior.

    The mean and the variances are those of all valid poses. The correlation matrix C is shrunk towards the identity:
    C ← (1 − ρ) C + ρ I, where ρ is the `oas_shrinkage` for the `effective_count` of the poses. No standard deviation is
    below 0.02 rad. The covariance is therefore positive definite, also for few poses. The prior of bone lengths is
    learnt in the same way, with one sample per bird, if the bone lengths differ between birds.

    The results depend on the prior of their own fit: the learnt prior is closer to that prior, and narrower, than the
    true distribution of poses. Use results that were fitted with a small weight of `pose_prior`.

    Args:
        results: for each result its name in error messages, its poses and its model.

    Raises:
        InputError: the results have different models, or no valid pose.
    """
    first_source, _, bird = results[0]
    tracks, bones, diverged = [], [], 0
    for source, solution, model in results:
        if (model.name, model.joint_names) != (bird.name, bird.joint_names):
            problem = f"has the model {model.name}, but {first_source} has the model {bird.name}, or the joints differ"
            raise InputError(source, problem, "learn from results of one model")
        next_frame = consecutive(solution.frame_index)
        for n, status in enumerate(solution.status):
            valid = solution.valid[n]
            diverged += status == "diverged"
            if valid.any():
                pose = solution.poses.body_pose[n].astype(np.float64)
                tracks.append((pose.reshape(len(valid), -1), valid, next_frame))
                bones.append(solution.poses.bone_length[n, valid].mean(axis=0, dtype=np.float64))
    if not tracks:
        skipped = f"; diverged birds: {diverged}" if diverged else ""
        raise InputError(first_source, f"holds no valid pose{skipped}", "use results with fitted birds")
    poses = np.concatenate([pose[valid] for pose, valid, _ in tracks])
    effective = effective_count(tracks)
    mean, covariance, shrinkage = _gaussian(poses, effective, MIN_SD_RAD)
    learnt = replace(
        bird, pose_mean=jnp.asarray(mean, jnp.float32), pose_covariance=jnp.asarray(covariance, jnp.float32)
    )
    bones_learnt = bool(np.ptp(np.array(bones), axis=0).max() > 1e-4)
    if bones_learnt:
        bone_mean, bone_covariance, _ = _gaussian(np.array(bones), len(bones), MIN_BONE_SD)
        learnt = replace(
            learnt,
            bone_mean=jnp.asarray(bone_mean, jnp.float32),
            bone_covariance=jnp.asarray(bone_covariance, jnp.float32),
        )
    change = (mean - np.asarray(bird.pose_mean, np.float64)).reshape(-1, 3)
    mean_change_rad = np.linalg.norm(change, axis=1)
    priors = priors_of(bird)
    whitened = (poses - np.asarray(priors.pose_mean)) @ np.asarray(priors.pose_whitener).T
    return LearntPrior(
        bird=learnt,
        poses=len(poses),
        birds=len(tracks),
        diverged=diverged,
        effective_poses=effective,
        shrinkage=shrinkage,
        bones_learnt=bones_learnt,
        mean_change_rad=mean_change_rad,
        width=max(float((whitened**2).mean()), MIN_WIDTH),
    )


def effective_count(
    tracks: Sequence[tuple[Float[np.ndarray, "T D"], Bool[np.ndarray, "T"], Bool[np.ndarray, "pairs"]]],
) -> float:
    """Return the number of independent poses with the same information: n (1 − r)/(1 + r), at least one per track.

    n is the number of valid poses, and r the correlation of consecutive valid frames over all tracks and components of
    the standardised poses. The equation holds for an autoregressive process of order 1.

    Args:
        tracks: for each track its poses, whether each pose is valid, and whether each of the T − 1 pairs of neighbours
            are consecutive frames.

    Source: Bayley and Hammersley 1946, *The "Effective" Number of Independent Observations in an Autocorrelated Time
    Series*.
    """
    poses = np.concatenate([pose[valid] for pose, valid, _ in tracks])
    spread = np.maximum(poses.std(axis=0), 1e-9)
    covariance = variance = 0.0
    pair_count = 0
    for pose, valid, next_frame in tracks:
        pairs = valid[:-1] & valid[1:] & next_frame
        before, after = ((frames[pairs] - poses.mean(axis=0)) / spread for frames in (pose[:-1], pose[1:]))
        covariance += (before * after).sum()
        variance += ((before**2 + after**2) / 2).sum()
        pair_count += pairs.sum()
    # without variance: r = 1 for birds that never move, r = 0 (independent frames) without consecutive frames
    r = np.clip(covariance / variance, 0.0, 1.0) if variance else float(pair_count > 0)
    return max(float(len(poses) * (1 - r) / (1 + r)), float(len(tracks)))


def oas_shrinkage(matrix: Float[np.ndarray, "D D"], count: float) -> float:
    """Return the shrinkage ρ of a sample covariance S of n samples towards (tr S/D) I, by oracle approximation.

    ρ = min(1, ((1 − 2/D) tr S² + tr² S) / ((n + 1 − 2/D) (tr S² − tr² S/D))).

    Args:
        matrix: the sample covariance S.
        count: the number of samples n.

    Source: Chen, Wiesel, Eldar and Hero 2010, *Shrinkage Algorithms for MMSE Covariance Estimation*, eq. 23.
    """
    size, trace, squared = len(matrix), float(np.trace(matrix)), float((matrix**2).sum())
    numerator = (1 - 2 / size) * squared + trace**2
    denominator = (count + 1 - 2 / size) * (squared - trace**2 / size)
    return min(1.0, numerator / denominator) if denominator > 0 and math.isfinite(denominator) else 1.0


def _gaussian(
    samples: Float[np.ndarray, "n D"], count: float, min_sd: float
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"], float]:
    """Return mean, covariance with shrunk correlations, and the shrinkage."""
    mean = samples.mean(axis=0)
    deviation = samples - mean
    sd = np.sqrt((deviation**2).mean(axis=0) + min_sd**2)
    # `min_sd` acts as independent noise: it increases the variances, not the covariances
    correlation = (deviation / sd).T @ (deviation / sd) / len(samples)
    np.fill_diagonal(correlation, 1.0)
    shrinkage = oas_shrinkage(correlation, count)
    shrunk = (1 - shrinkage) * correlation + shrinkage * np.eye(len(mean))
    return mean, sd[:, None] * shrunk * sd, shrinkage
