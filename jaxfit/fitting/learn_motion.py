"""Learn the scale and the degrees of freedom of `motion_likelihood` from results.

The density is that of the term: a trivariate Student t of the acceleration of the root and of every joint. Only the
norm of an acceleration enters the density. A bird is therefore stored as a histogram of norms with narrow logarithmic
bins, so that the fit of all birds but one takes the same short time for any number of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from jaxfit.config.fit import load_config
from jaxfit.config.yaml_values import rounded
from jaxfit.data.frame_numbers import UNKNOWN_FPS, assumed_interval_s, consecutive, frame_interval_s
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.model.anatomy import joint_group

__all__ = [
    "LearntMotion",
    "MotionPrior",
    "accelerations_rad_s2",
    "learn_motion",
    "maximum_likelihood",
    "mean_cost",
    "motion_config",
    "norm_histogram",
    "shipped_motion",
]

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
    for b, own in enumerate(counts if len(counts) > 1 else ()):
        others = _shrunk(maximum_likelihood(total - own), shipped, effective_birds(np.delete(frames, b)))
        held_out.append(own.sum() * mean_cost(own, others))
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
    orient, body = solution.global_orient[n][:, None], solution.body_pose[n]
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
    return MotionPrior(*(own ** (1 - share) * other**share for own, other in zip(learnt, shipped, strict=True)))


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
