"""`on_ledge`: the birds of a fit in a world whose plane z = 0 is the ledge that they stand on.

A fit of one camera knows the direction of every bird, its orientation and its size in the picture, but not its
distance. The ledge gives the distance: a bird that stands has its feet on the ledge. World: z up, metres.

`find_contacts` says when a bird stands: its two states, on the ledge and in the air, are a hidden Markov chain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.cameras.camera import Camera
from jaxfit.config.fit import FitConfig
from jaxfit.data.projection import InImage, PosedBirds, in_image
from jaxfit.data.solution import Keypoints, Solution
from jaxfit.data.tracks import assumed_interval_s, frame_interval_s, frame_step
from jaxfit.data.world import in_world, largest_image_px, whole_picture
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird

NOISE_SD, NOISE_COUNT = 0.01, 10.0
"""Standard deviation of the logarithm of the size of a standing bird from frame to frame, before it is learnt from the
birds, and the weight of this value in poses."""
SLOW = 1.0
"""Body lengths per second below which a bird is not in flight: no bird flies slower, hovering apart."""
STANDING_SPEED = 0.5
"""Scale of the speed of a bird on the ledge, body lengths per second; half-Cauchy, so that a bird may also run."""
FLYING_SPEED = 30.0
"""Largest speed of a bird in the air, body lengths per second; uniform."""
SIZE_RANGE = 2.0
"""Range of the logarithm of the size that a bird in the air seems to have; uniform."""
STATE_S = 10.0
"""Mean time for which a bird stays on the ledge or in the air, seconds."""
FEET = "left_ankle", "right_ankle", "left_foot", "right_foot"
"""Joints whose vertices touch the ledge; a model without them touches it anywhere."""
SPEED_S = 0.2
"""Time over which a speed is measured, seconds."""
CHUNK = 256
"""Frames that are posed at once."""
_ROUNDS = 10


class Contacts(NamedTuple):
    """The birds on the ledge."""

    probability: Float[np.ndarray, "N T"]
    """Probability that the bird stands on the ledge; NaN without a pose."""
    log_size: Float[np.ndarray, "N"]
    """Logarithm of the size of each bird relative to the model, from the frames in which it stands."""


def find_contacts(
    log_size: Float[np.ndarray, "N T"],
    speed: Float[np.ndarray, "N T"],
    interval_s: float,
    mean_log_size: float,
) -> Contacts:
    """Return when birds stand on the ledge, and their sizes.

    A bird has one size. With its feet on the ledge, it seems to have this size in every frame; a bird in the air
    seems larger, because the ledge is farther away. The two states of a bird, on the ledge and in the air, are a hidden
    Markov chain; the size, and the standard deviation of the noise of all birds, are estimated by expectation
    maximisation.

    Args:
        log_size: logarithm of the size at which the feet are on the ledge; NaN without a pose, and +inf where the ray
            of a foot does not meet the ledge.
        speed: body lengths per second, NaN where unknown.
        interval_s: time between frames.
        mean_log_size: logarithm of the mean size of the birds.

    Source: Rabiner 1989, *A tutorial on hidden Markov models*.
    """
    seen, meets = ~np.isnan(log_size), np.isfinite(log_size)
    quick = np.nan_to_num(speed)
    by_speed = np.log(2 / (np.pi * STANDING_SPEED) / (1 + (quick / STANDING_SPEED) ** 2)) + np.log(FLYING_SPEED)
    slow = meets & (quick < STANDING_SPEED)
    own = np.full(len(log_size), mean_log_size)
    for n in range(len(own)):
        if meets[n].any():
            own[n] = np.median(log_size[n, slow[n]] if slow[n].any() else log_size[n, meets[n]])
    variance, change = NOISE_SD**2, min(interval_s / STATE_S, 0.5)
    probability = np.where(seen, 0.5, np.nan)
    for _ in range(_ROUNDS):
        # E step: log-likelihood ratio of standing to flying. Standing: the size is normal about that of the bird, the
        # speed half-Cauchy. Flying: both are uniform over their ranges.
        error = np.where(meets, log_size - own[:, None], 0)
        by_size = -(error**2) / (2 * variance) - 0.5 * np.log(2 * np.pi * variance) + np.log(SIZE_RANGE)
        ratio = np.where(seen, np.where(meets, by_size + by_speed, -50.0), 0.0)
        probability = _smoothed(ratio, change)
        # M step: means weighted by the probability of standing, with a prior of `NOISE_COUNT` poses on the variance
        weight = np.where(meets, probability, 0)
        total = weight.sum(axis=1)
        # poses of one bird in near frames agree, so the prior of the size is weak against any bird that stands
        evidence = np.where(meets, weight * np.where(meets, log_size, 0), 0).sum(axis=1) / np.maximum(total, 1e-9)
        own = np.where(total > 0.5, evidence, mean_log_size)
        squares = (weight * np.where(meets, log_size - own[:, None], 0) ** 2).sum()
        variance = (NOISE_COUNT * NOISE_SD**2 + squares) / (NOISE_COUNT + total.sum())
    return Contacts(np.where(seen, probability, np.nan), own)


def _smoothed(ratio: Float[np.ndarray, "N T"], change: float) -> Float[np.ndarray, "N T"]:
    """Return the probability of the first of two states in every frame, by the forward-backward algorithm.

    Args:
        ratio: logarithm of the likelihood ratio of the first state to the second state.
        change: probability of a change of state between two frames.
    """

    return np.asarray(_forward_backward(jnp.asarray(ratio.T, jnp.float32), change), np.float64).T


@jax.jit
def _forward_backward(ratio: Float[Array, "T N"], change: float) -> Float[Array, "T N"]:
    """Return `_smoothed` with the frames first."""

    def passed(logit: Array) -> Array:
        # p′ = p·(1 − c) + (1 − p)·c, the probability after one step of the chain, as a logit
        first = jax.nn.sigmoid(logit)
        # not 1 − mixed, which rounding makes 0
        mixed, other = first + (1 - 2 * first) * change, (1 - first) + (2 * first - 1) * change
        return jnp.log(mixed) - jnp.log(other)

    def onward(logit: Array, own: Array) -> tuple[Array, Array]:
        seen = own + passed(logit)
        return seen, seen

    def back(logit: Array, own: Array) -> tuple[Array, Array]:
        return passed(own + logit), logit

    unknown = jnp.zeros(ratio.shape[1])
    forward = jax.lax.scan(onward, unknown, ratio)[1]
    backward = jax.lax.scan(back, unknown, ratio, reverse=True)[1]
    return jax.nn.sigmoid(forward + backward)


def interval_of(solution: Solution) -> float:
    """Return the time between consecutive frames, seconds; of a video of 25 frames/s if the rate is unknown."""
    numbers = solution.frame_index
    return frame_interval_s(numbers, solution.timestamp_s, solution.fps) or assumed_interval_s(numbers)


def speed_lengths(solution: Solution, bird: Bird, interval_s: float) -> Float[np.ndarray, "N T"]:
    """Return the speed of each bird across the picture, body lengths per second; NaN where it is unknown.

    It is the distance that the mean keypoint moves in `SPEED_S`, relative to the length of the bird in the picture.
    """
    s, step = solution, max(round(SPEED_S / interval_s), 1)
    length = np.ptp(np.asarray(bird.vertices), axis=0).max()
    depth = np.where(s.valid, s.poses.transl[..., 2] / s.poses.scale, np.nan)
    length_px = length / depth * s.crops.focal_px / s.crops.crop_px * s.crops.square_px[..., 2]
    place = np.where(s.valid[..., None], s.keypoints.px.mean(axis=2), np.nan)
    T = place.shape[1]
    # about the frame; at the end of the video, before it
    last = np.minimum(np.arange(T) + (step + 1) // 2, T - 1)
    first = np.maximum(last - step, 0)
    seconds = np.maximum(s.frame_index[last] - s.frame_index[first], 1) / frame_step(s.frame_index) * interval_s
    return np.linalg.norm(place[:, last] - place[:, first], axis=-1) / length_px / seconds


def feet_cam(solution: Solution, bird: Bird, n: int | None = None) -> Float[np.ndarray, "N T P 3"]:
    """Return the vertices that can touch the ledge, in the camera frames of the crops, model units.

    Args:
        solution: the poses.
        bird: the model.
        n: position of a track; None takes all tracks.
    """
    named = [j for j, name in enumerate(bird.joint_names) if name in FEET]
    touching = np.asarray(bird.skin_weights)[:, named].sum(axis=1) > 0.5
    chosen = np.flatnonzero(touching if touching.any() else np.ones_like(touching))
    posed, T = PosedBirds(solution, bird, vertices=chosen), len(solution.frame_index)
    rows = range(len(solution.track_id)) if n is None else [n]
    found = np.empty((len(rows), T, len(chosen), 3))
    for i, row in enumerate(rows):
        for first in range(0, T, CHUNK):
            start = max(min(first, T - CHUNK), 0)  # slices of equal length share one compiled program
            found[i, start : start + CHUNK] = posed.vertices_cam_window(row, slice(start, start + CHUNK))
    return found


def ledge_config(config: FitConfig) -> FitConfig:
    """Return a config whose silhouettes do not bias the size of the birds, and with it their distances."""
    return replace(config, edge="unbiased", unknown_pixels=True)


def on_ledge(
    solution: Solution, bird: Bird, camera: Camera, lens: Camera | None = None, known_sizes: bool = False
) -> Solution:
    """Return the poses of one camera in a world whose plane z = 0 is the ledge.

    A bird that moves along the viewing ray, and grows with its distance, looks the same. So the plane moves every bird
    along its ray: with a foot on the plane where it stands, with its own size where it flies, and between them in
    proportion to the probability that it stands (`find_contacts`).

    Args:
        solution: poses in crops, or in the whole picture of `camera`.
        bird: the model, with its unit of length.
        camera: the camera without distortion, in the world of the ledge.
        lens: the same camera as it films; None: `camera`.
        known_sizes: whether several cameras know the places and sizes of the birds, which stay as they are.

    Returns:
        Poses in the frame of the camera, whose crop is the whole picture, in the world (`World`), with
        `contact`. The size of a bird is its true size.
    """
    s, unit_m, interval_s = solution, metres(bird), interval_of(solution)
    lens = lens or camera
    placed = in_image(s, bird, float(camera.matrix[0, 0]), tuple(camera.matrix[:2, 2]))
    up, height = camera.R_cam_world[:, 2], float(camera.position_world[2]) / unit_m
    low = np.zeros(s.valid.shape)  # height of the lower foot relative to the camera, model units, before it is moved
    for n in range(len(low)):
        one = InImage(placed.focal_px, *(values[n : n + 1] for values in placed[1:]))
        low[n] = (one.points(feet_cam(s, bird, n), np.asarray(s.poses.scale[n : n + 1])) @ up).min(axis=-1)[0]
    with np.errstate(all="ignore"):
        log_size = np.where(low < 0, np.log(height / -low), np.inf)
    log_size = np.where(s.valid, log_size, np.nan)
    speed = speed_lengths(s, bird, interval_s)
    known = log_size[np.isfinite(log_size) & (np.nan_to_num(speed) < SLOW)]
    contacts = find_contacts(log_size, speed, interval_s, float(np.median(known)) if known.size else 0.0)
    p, standing = np.nan_to_num(contacts.probability), np.where(np.isfinite(log_size), log_size, 0)
    k = np.ones_like(p) if known_sizes else np.exp(p * standing + (1 - p) * contacts.log_size[:, None])
    return _in_world(s, bird, placed, k, camera, lens, contacts.probability, unit_m)


def _in_world(
    solution: Solution,
    bird: Bird,
    placed: InImage,
    factor: Float[np.ndarray, "N T"],
    camera: Camera,
    lens: Camera,
    contact: Float[np.ndarray, "N T"],
    unit_m: float,
) -> Solution:
    """Return the solution in the frame of the whole picture, with all birds moved along their rays by a factor."""
    s, joint = solution, np.asarray(bird.joints[0], np.float64)
    scale, root = factor * placed.size, factor[..., None] * placed.root
    growth = scale / s.poses.scale
    points = factor[..., None, None] * placed.points(
        s.keypoints.cam.astype(np.float64), np.asarray(s.poses.scale, np.float64)
    )
    world = in_world(camera, unit_m, placed.orientation, root, points)
    bars = s.error_bars
    if bars is not None:
        turn = placed.turn[:, :, None] * growth[..., None, None, None]
        bars = replace(
            bars,
            keypoints_cam_cov=(turn @ bars.keypoints_cam_cov @ turn.swapaxes(-1, -2)).astype(np.float32),
            keypoints_centred_cov=(turn @ bars.keypoints_centred_cov @ turn.swapaxes(-1, -2)).astype(np.float32),
            transl_sd=(bars.transl_sd * growth[..., None]).astype(np.float32),
            scale_sd=(bars.scale_sd * growth).astype(np.float32),
        )
    pixels = np.nan_to_num(lens.project(world.keypoints_world_m))
    return replace(
        s,
        poses=replace(
            s.poses,
            global_orient=placed.orientation.astype(np.float32),
            transl=(root - scale[..., None] * joint).astype(np.float32),
            scale=scale.astype(np.float32),
        ),
        keypoints=Keypoints(cam=points.astype(np.float32), px=pixels.astype(np.float32)),
        crops=whole_picture(lens, s.valid, largest_image_px(s)),
        error_bars=bars,
        world=world,
        contact=contact.astype(np.float32),
    )


def metres(bird: Bird) -> float:
    """Return the length of a model unit in metres.

    Raises:
        InputError: the model has none.
    """
    if bird.metres_per_unit is None:
        remedy = "import the model with --length-cm, or use a model of your species (docs/guide/species.md)"
        raise InputError(f"model {bird.name}", "has no unit of length, which a world in metres needs", remedy)
    return bird.metres_per_unit
