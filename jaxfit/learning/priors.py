"""Priors of poses and motion from fitted results.

The frames of one bird are correlated, so 1000 frames contain much less information than 1000 birds. The shrinkage of
the covariance therefore depends on the effective number of poses: the number of independent poses with the same
information.

Learn the scale and the degrees of freedom of `motion_likelihood` from results. The density is that of the term: a
trivariate Student t of the acceleration of the root and of every joint. Only the norm of an acceleration enters the
density. A bird is therefore stored as a histogram of norms with narrow logarithmic bins, so that the fit of all birds
but one takes the same short time for any number of frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from jaxfit.config.fit import load_config
from jaxfit.config.yaml_file import rounded
from jaxfit.data.solution import Solution
from jaxfit.data.tracks import UNKNOWN_FPS, assumed_interval_s, consecutive, frame_interval_s
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import joint_group
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


LEAST_RAD_S2 = 0.01
"""Accelerations below this norm count as this norm: the rounding errors of poses in float32 have this size."""
BIN_WIDTH, BINS = 0.01, 3000
"""Width of a bin of log ‖a‖, and number of bins. The last bin begins at 10¹¹ rad/s²."""
NORMS = LEAST_RAD_S2 * np.exp(BIN_WIDTH * (np.arange(BINS) + 0.5))
"""Norm of the acceleration in the middle of each bin, radians per second²."""
BOUNDS = ((np.log(LEAST_RAD_S2), np.log(1e6)), (np.log(0.1), np.log(100.0)))
"""Limits of log `sd_rad_s2` and log `dof`. A result without any motion has its maximum of likelihood at a limit."""
SHIPPED_BIRDS = 4.0
"""Number of birds that the shipped values count for in the learnt values."""

Histogram = Float[np.ndarray, "bins"] | Int[np.ndarray, "bins"]


class MotionPrior(NamedTuple):
    """The settings of `motion_likelihood`."""

    sd_rad_s2: float
    dof: float


@dataclass(frozen=True, eq=False)
class LearntMotion:
    """The learnt settings of `motion_likelihood`, and the data behind these settings."""

    prior: MotionPrior
    """The learnt settings, shrunk towards the shipped settings."""
    unshrunk: MotionPrior
    """The settings of maximum likelihood."""
    shipped: MotionPrior
    """The settings of the config `map`."""
    birds: int
    """Number of birds with at least three consecutive valid frames."""
    diverged: int
    """Number of skipped birds: all windows of the bird diverged."""
    frames: int
    """Number of runs of three consecutive valid frames of a bird. A run has one acceleration of every joint."""
    effective_birds: float
    """Number of birds of equal length with the same information, see `effective_birds`."""
    shrinkage: float
    """Share of the shipped settings between 0 and 1."""
    rates_fps: tuple[float, ...]
    """Rates of the poses, frames per second, in increasing order."""
    unknown_rates: int
    """Number of results whose frame rate is not known; they count as results at 25 frames/s."""
    cost: float | None
    """Cost in nats of the learnt settings per joint and frame, of birds that were left out. None: only one bird."""
    shipped_cost: float
    """Cost in nats of the shipped settings per joint and frame."""
    groups: dict[str, Float[np.ndarray, "n"]]
    """Group of joints → norms of its accelerations, radians per second²."""


def learn_motion(results: Sequence[tuple[object, Solution]]) -> LearntMotion:
    """Learn the scale s and the degrees of freedom ν of `motion_likelihood` from results.

    The settings of maximum likelihood are shrunk towards the shipped settings by the number of birds, because the
    frames of one bird resemble each other: log s ← (1 − ρ) log s + ρ log s₀, and the same for ν, with
    ρ = 4/(4 + B) and B the number of `effective_birds`. The shipped settings thus count like four birds.

    The cost is cross-validated: for each bird, the settings are learnt from all other birds and evaluated on this bird.

    Fits are smoothed by the motion term of their own config, so the scale that is learnt from fits is too small.

    Args:
        results: for each result its name in error messages, and its poses.

    Raises:
        InputError: no result has a bird with three consecutive valid frames.
    """
    histograms, frames, diverged, unknown = [], [], 0, 0
    rates, groups = set(), {}
    for _, solution in results:
        frame_s = frame_interval_s(solution.frame_index, solution.timestamp_s, solution.fps)
        unknown += frame_s is None
        frame_s = frame_s or assumed_interval_s(solution.frame_index)
        names = [joint_group(name) for name in solution.joint_names]
        for n, status in enumerate(solution.status):
            diverged += status == "diverged"
            norms = np.linalg.norm(accelerations_rad_s2(solution, n, frame_s)[0], axis=-1)
            if len(norms) == 0:
                continue
            rates.add(float(f"{1 / frame_s:.5g}"))
            histograms.append(norm_histogram(norms))
            frames.append(len(norms))
            for j, name in enumerate(names):
                groups.setdefault(name, []).append(norms[:, j])
    if not histograms:
        skipped = f"; diverged birds: {diverged}" if diverged else ""
        problem = f"holds no bird with three consecutive valid frames{skipped}"
        raise InputError(results[0][0], problem, "use results of videos with fitted birds")
    counts, shipped = np.stack(histograms), shipped_motion()
    total, effective = counts.sum(axis=0), effective_birds(frames)
    unshrunk, held_out = maximum_likelihood(total), []
    for b, of_bird in enumerate(counts if len(counts) > 1 else ()):
        others = _shrunk(maximum_likelihood(total - of_bird), shipped, effective_birds(np.delete(frames, b)))
        held_out.append(of_bird.sum() * mean_cost(of_bird, others))
    return LearntMotion(
        prior=_shrunk(unshrunk, shipped, effective),
        unshrunk=unshrunk,
        shipped=shipped,
        birds=len(counts),
        diverged=diverged,
        frames=sum(frames),
        effective_birds=effective,
        shrinkage=_shrinkage(effective),
        rates_fps=tuple(sorted(rates)),
        unknown_rates=unknown,
        cost=float(sum(held_out) / total.sum()) if held_out else None,
        shipped_cost=mean_cost(total, shipped),
        groups={name: np.concatenate([part.ravel() for part in parts]) for name, parts in groups.items()},
    )


def shipped_motion() -> MotionPrior:
    """Return the settings of `motion_likelihood` in the config `map`."""
    config = load_config("map")
    settings = config.stage_settings(config.stages[-1])["motion_likelihood"]
    return MotionPrior(settings["sd_rad_s2"], settings["dof"])


def accelerations_rad_s2(
    solution: Solution, n: int, frame_s: float
) -> tuple[Float[np.ndarray, "runs J 3"], Bool[np.ndarray, "triples"]]:
    """Return the angular accelerations of a bird, as `motion_likelihood` defines them, and where they are.

    Args:
        solution: the poses.
        n: position of the track.
        frame_s: time between consecutive frames in seconds.

    Returns:
        The accelerations of the root and of all joints, radians per second², one row for each run of three consecutive
        valid frames; and, for each frame but the last two, whether such a run begins there.
    """
    pairs = solution.valid[n, :-1] & solution.valid[n, 1:] & consecutive(solution.frame_index)
    runs = pairs[:-1] & pairs[1:]
    orient, body = solution.poses.global_orient[n][:, None], solution.poses.body_pose[n]
    rotvec = np.concatenate([orient, body], axis=1).astype(np.float64)
    triples = [rotvec[shift : shift + len(runs)][runs].reshape(-1, 3) for shift in range(3)]
    if not runs.any():
        return np.zeros((0, rotvec.shape[1], 3)), runs
    first, second, third = map(Rotation.from_rotvec, triples)
    change = (second.inv() * third).as_rotvec() - (first.inv() * second).as_rotvec()
    return change.reshape(-1, *rotvec.shape[1:]) / frame_s**2, runs


def norm_histogram(norms: Float[np.ndarray, "..."]) -> Int[np.ndarray, "bins"]:
    """Return the number of accelerations in each bin; the norms are in radians per second²."""
    at = np.log(np.maximum(norms, LEAST_RAD_S2) / LEAST_RAD_S2) / BIN_WIDTH
    return np.bincount(np.minimum(at.astype(int), BINS - 1).ravel(), minlength=BINS)


def mean_cost(counts: Histogram, prior: MotionPrior) -> float:
    """Return the mean negative log-density of accelerations in nats, with all constants.

    −log p(a) = log Γ(ν/2) − log Γ((ν + 3)/2) + 3/2 log(νπ) + 3 log s + (ν + 3)/2 log(1 + ‖a‖²/(ν s²)), with a and s in
    radians per second².

    Args:
        counts: the histogram of the norms.
        prior: scale s and degrees of freedom ν.
    """
    s, dof = prior
    constant = gammaln(dof / 2) - gammaln((dof + 3) / 2) + 1.5 * np.log(dof * np.pi) + 3 * np.log(s)
    robust = (dof + 3) / 2 * np.log1p((NORMS / s) ** 2 / dof)
    return float(constant + counts @ robust / counts.sum())


def maximum_likelihood(counts: Histogram) -> MotionPrior:
    """Return the settings with the least mean cost of the accelerations of a histogram, within `BOUNDS`."""
    middle = NORMS[np.searchsorted(np.cumsum(counts), counts.sum() / 2)]
    starts = [(np.log(middle), np.log(dof)) for dof in (0.5, 4.0)]
    fits = [
        minimize(lambda x: mean_cost(counts, MotionPrior(*np.exp(x))), start, method="L-BFGS-B", bounds=BOUNDS)
        for start in starts
    ]
    return MotionPrior(*np.exp(min(fits, key=lambda fit: fit.fun).x).tolist())


def effective_birds(frames: Sequence[int] | np.ndarray) -> float:
    """Return the number of birds of equal length with the same information: (Σ n_b)²/Σ n_b², n_b frames of bird b.

    Source: Kish 1965, *Survey Sampling*.
    """
    count = np.asarray(frames, np.float64)
    return float(count.sum() ** 2 / (count**2).sum())


def _shrinkage(effective: float) -> float:
    return SHIPPED_BIRDS / (SHIPPED_BIRDS + effective)


def _shrunk(learnt: MotionPrior, shipped: MotionPrior, effective: float) -> MotionPrior:
    """Return the geometric mean of learnt and shipped settings, weighted by the number of birds."""
    share = _shrinkage(effective)
    return MotionPrior(*(new ** (1 - share) * old**share for new, old in zip(learnt, shipped, strict=True)))


def motion_config(learnt: LearntMotion) -> str:
    """Return the config of the learnt settings as YAML text, with the data behind the settings as comments."""
    rates, (sd_rad_s2, dof) = ", ".join(f"{rate:g}" for rate in learnt.rates_fps), learnt.prior
    lines = [
        "# Config of a fit with a learnt term motion_likelihood, written by `jaxfit prior learn --motion`.",
        f"# Learnt from birds: {learnt.birds}; runs of three frames: {learnt.frames}; frames per second: {rates}.",
    ]
    if learnt.unknown_rates:
        lines.append(f"# Results of unknown frame rate, taken as {UNKNOWN_FPS:g} frames/s: {learnt.unknown_rates}.")
    lines += [
        f"# The shipped values have a share of {100 * learnt.shrinkage:.0f} %.",
        "# Fits are smoothed by their own motion term: a scale that is learnt from fits is too small.",
        "# Simulated motion is smoother than real motion: a scale that is learnt from simulated scenes is too small.",
        "base: map",
        "terms:",
        f"  motion_likelihood: {{weight: 1, sd_rad_s2: {rounded(sd_rad_s2, 4)}, dof: {rounded(dof, 4)}}}",
    ]
    return "\n".join(lines) + "\n"
