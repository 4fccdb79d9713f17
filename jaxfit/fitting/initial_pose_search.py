"""Search for initial poses: the orientations of all frames of a window are chosen together.

Each candidate orientation of each frame has a matching cost: the robust distance between the detected keypoints and
the keypoints of the mean pose under a scaled orthographic camera (closed form). Dynamic programming then chooses one
of the best candidates in each frame, such that the sum of matching costs and rotations between frames is smallest. If
the frames were chosen independently, some frames would be flipped against their neighbours, and no weight of the
temporal terms corrects such a flip.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.config.fit import InitialiseConfig
from jaxfit.fitting.tiles import join_tiles, take_tile, tile_rows, tile_size
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig, joint_transforms, posed_keypoints
from jaxfit.model.pose import Pose, rest_pose
from jaxfit.model.rotation import matrix_to_axis_angle, unwrap_axis_angle, view_grid, viewing_axis_rotations

__all__ = ["candidate_orientations", "choose_sequence", "match_candidates", "search_initial_poses"]

SIGMA_PX = 30.0
"""Scale of the robust matching cost, in pixels of a 256-pixel crop. On a bird of 200 pixels, the keypoints of the mean
pose are about this far from the keypoints of the true pose."""
LEAST_SEPARATION_RAD = np.pi / 4
"""In every frame, the orientations of two hypotheses differ by more than this angle."""
LEAST_SPAN = 0.1
"""The initial scale is at least such that the keypoints of the resting bird span this share of the crop."""
EXCLUDED_COST = 1e9
"""Cost of a candidate that is too close to an earlier hypothesis, in squared pixels of a 256-pixel crop."""


class OrthographicMatch(NamedTuple):
    """The match between candidates and the keypoints of one frame under a scaled orthographic camera."""

    cost: Float[Array, "*B"]
    """Σ_i c_i · σ²e_i²/(σ² + e_i²), with e_i the distance of keypoint i; squared pixels of a 256-pixel crop."""
    scale_px: Float[Array, "*B"]
    """Pixels of a 256-pixel crop per model unit."""


def candidate_orientations(config: InitialiseConfig) -> Float[np.ndarray, "C 3 3"]:
    """Return the candidate rotations model → camera.

    In bird models, x points sideways, y towards the bill and z up (dorsal). If the bird is seen from above, z points to
    the camera. The paper's candidates are this view, rotated about the viewing axis in steps of 12°.
    """
    if config.method == "so3":
        return view_grid(config.directions, config.turns)
    from_above = np.diag([1.0, -1.0, -1.0])
    return viewing_axis_rotations(config.turns) @ from_above


def match_candidates(
    candidates: Float[Array, "C 3 3"],
    model_keypoints: Float[Array, "K 3"],
    keypoints_px: Float[Array, "K 2"],
    confidence: Float[Array, "K"],
) -> OrthographicMatch:
    """Match every candidate orientation to one frame by scale and shift.

    The match is robust: least squares with 4 reweightings.

    Args:
        candidates: rotations model → camera.
        model_keypoints: keypoints of the mean pose, model units.
        keypoints_px: crop pixels.
        confidence: 0 where a keypoint is missing.

    Returns:
        Costs and scales, (C,). If all confidences are 0, the costs are 0.
    """
    flat = jnp.einsum("cij,kj->cki", candidates[:, :2], model_keypoints)  # (C, K, 2)
    weight = jnp.broadcast_to(confidence, flat.shape[:2])
    for _ in range(4):
        scale, shift = _similarity(flat, keypoints_px, weight)
        squared = jnp.sum((scale[:, None, None] * flat + shift[:, None] - keypoints_px) ** 2, -1)
        weight = confidence * (SIGMA_PX**2 / (SIGMA_PX**2 + squared)) ** 2
    cost = jnp.sum(confidence * SIGMA_PX**2 * squared / (SIGMA_PX**2 + squared), axis=1)
    return OrthographicMatch(cost, scale)


def _similarity(flat, keypoints_px, weight):
    """Return the least-squares scale (C,) and shift (C, 2) from orthographic points (C, K, 2) to pixels."""
    total = jnp.maximum(jnp.sum(weight, axis=1), 1e-6)[:, None]
    mean_flat = jnp.sum(weight[..., None] * flat, axis=1) / total
    mean_px = jnp.sum(weight[..., None] * keypoints_px, axis=1) / total
    centred, target = flat - mean_flat[:, None], keypoints_px - mean_px[:, None]
    spread = jnp.maximum(jnp.sum(weight[..., None] * centred**2, axis=(1, 2)), 1e-6)
    # A negative scale means a rotation by 180°, which is another candidate. The lower bound keeps its cost high here.
    scale = jnp.maximum(jnp.sum(weight[..., None] * centred * target, axis=(1, 2)) / spread, 1e-2)
    return scale, mean_px - scale[:, None] * mean_flat


def choose_sequence(cost: Float[Array, "T M"], rotation: Float[Array, "T M 3 3"], smoothness: float) -> Int[Array, "T"]:
    """Return the candidate of each frame, such that Σ_t cost_t + smoothness · Σ_t angle_t,t+1 is smallest.

    The minimum is exact, by dynamic programming (Viterbi). Angles between consecutive frames are in radians.
    """

    def forward(best, current):
        cost_t, angle = current
        transition = best[:, None] + smoothness * angle
        return cost_t + jnp.min(transition, axis=0), jnp.argmin(transition, axis=0)

    # cos θ = (tr(RaᵀRb) − 1) / 2, for all pairs of candidates of consecutive frames
    trace = jnp.einsum("tmij,tnij->tmn", rotation[:-1], rotation[1:])
    angles = jnp.arccos(jnp.clip((trace - 1) / 2, -1, 1))
    total, predecessors = jax.lax.scan(forward, cost[0], (cost[1:], angles))
    last = jnp.argmin(total)
    _, earlier = jax.lax.scan(lambda i, of_frame: (of_frame[i], of_frame[i]), last, predecessors, reverse=True)
    return jnp.concatenate([earlier, last[None]])


def _orientations(
    candidates: Float[Array, "C 3 3"],
    model_keypoints: Float[Array, "K 3"],
    keypoints_px: Float[Array, "T K 2"],
    confidence: Float[Array, "T K"],
    config: InitialiseConfig,
) -> tuple[Float[Array, "H T 3 3"], Float[Array, "H T"]]:
    """Return orientations and scales (pixels per model unit) of the H best distinct sequences of one window."""
    has_keypoints = jnp.any(confidence > 0, axis=1)
    frames = jnp.arange(len(has_keypoints))
    # a frame without keypoints has the candidates of the nearest frame with keypoints, with a matching cost of 0
    distance = jnp.abs(frames[:, None] - frames) + jnp.where(has_keypoints, 0, len(frames))
    nearest = jnp.argmin(distance, axis=1)
    match = jax.lax.map(lambda frame: match_candidates(candidates, model_keypoints, *frame), (keypoints_px, confidence))
    cost = match.cost[nearest]
    exclusion = jnp.zeros_like(cost)
    orientations, scales = [], []
    for _ in range(config.hypotheses):
        _, index = jax.lax.top_k(-(cost + exclusion), min(config.candidates, cost.shape[1]))
        frame_cost = jnp.take_along_axis(cost + exclusion, index, axis=1) * has_keypoints[:, None]
        path = choose_sequence(frame_cost, candidates[index], config.smoothness)
        chosen = index[frames, path]
        orientations.append(candidates[chosen])
        scales.append(match.scale_px[nearest, chosen])
        trace = jnp.einsum("tij,cij->tc", candidates[chosen], candidates)
        exclusion = jnp.where((trace - 1) / 2 > np.cos(LEAST_SEPARATION_RAD), EXCLUDED_COST, exclusion)
    return jnp.stack(orientations), jnp.stack(scales)


def search_initial_poses(
    bird: Bird,
    rig: Rig,
    keypoints_px: Float[Array, "W T K 2"],
    confidence: Float[Array, "W T K"],
    config: InitialiseConfig,
    camera: Camera,
    common_size: bool,
) -> Pose:
    """Return initial poses of W windows: H hypotheses with the mean body pose, at a depth with scale ≈ 1.

    Args:
        bird: the model.
        rig: the model, folded.
        keypoints_px: crop pixels.
        confidence: 0 where a keypoint is missing. A frame without keypoints has an orientation close to its neighbours.
        config: candidates and hypotheses.
        camera: the crop camera.
        common_size: whether the window has one scale, instead of one scale per frame.

    Returns:
        A Pose with leading axes W, H, then T.

    Source: Hägerlind et al. 2024, initialisation, for the candidates. The choice over the whole window is jaxfit's.
    """
    count, frames = keypoints_px.shape[:2]
    found = [
        _search_tile(bird, rig, *take_tile((keypoints_px, confidence), rows), config, camera, common_size)
        for rows in tile_rows(count, tile_size(frames))
    ]
    return jax.tree.map(jnp.asarray, join_tiles(found, count))


@partial(jax.jit, static_argnames=("config", "camera", "common_size"))
def _search_tile(
    bird: Bird,
    rig: Rig,
    keypoints_px: Float[Array, "G T K 2"],
    confidence: Float[Array, "G T K"],
    config: InitialiseConfig,
    camera: Camera,
    common_size: bool,
) -> Pose:
    """Return the initial poses of the G windows of a tile."""
    frames = keypoints_px.shape[1]
    rest = rest_pose(bird)
    model_keypoints, root = posed_keypoints(rig, joint_transforms(rig, rest), rest), rig.joints[0]
    candidates = jnp.asarray(candidate_orientations(config), jnp.float32)
    # no orientation matches wrong keypoints well, so their scale is almost 0 and the depth would be extreme
    least_scale_px = LEAST_SPAN * camera.size_px / jnp.ptp(model_keypoints, axis=0).max()

    def initial_pose(R, scale_px, keypoints_px, confidence) -> tuple[Array, Array, Array]:
        window_scale_px = jnp.maximum(jnp.median(scale_px), least_scale_px)
        depth = camera.focal_px / window_scale_px
        scale = jnp.ones(1) if common_size else jnp.clip(scale_px / window_scale_px, 0.5, 2.0)
        # the bird rotates about its root joint, as in `joint_transforms`
        rotated = jnp.einsum("tij,kj->tki", R, model_keypoints - root) + root
        scaled = rotated * scale[:, None, None]
        # at this depth, the shift aligns the mean of the model's keypoints with the mean of the detected keypoints
        weight = confidence[..., None] / jnp.maximum(jnp.sum(confidence, axis=1), 1e-6)[:, None, None]
        offset_px = jnp.sum(weight * (keypoints_px - camera.centre_px), axis=1)
        xy = offset_px * depth / camera.focal_px - jnp.sum(weight * scaled, axis=1)[:, :2]
        z = jnp.broadcast_to(depth - scale * root[2], (frames,))  # the root joint is at this depth
        transl = jnp.concatenate([xy, z[:, None]], axis=-1)
        return unwrap_axis_angle(matrix_to_axis_angle(R)), transl, scale

    def search_window(detections: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        R, scale_px = _orientations(candidates, model_keypoints, *detections, config)
        return jax.vmap(initial_pose, (0, 0, None, None))(R, scale_px, *detections)

    batch_size = max(1, 100 // frames)  # a window of 100 frames × 2,400 candidates needs about 100 MB
    orient, transl, scale = jax.lax.map(search_window, (keypoints_px, confidence), batch_size=batch_size)
    rest_poses = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*orient.shape[:2], *x.shape)), rest_pose(bird, frames, common_size)
    )
    return dataclasses.replace(rest_poses, global_orient=orient, transl=transl, scale=scale)
