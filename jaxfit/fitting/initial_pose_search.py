"""Where a fit starts: an orientation for every frame, chosen for the window as a whole.

Each candidate orientation of each frame is scored by how well the mean-pose keypoints match under a scaled
orthographic camera (closed form, robust). Dynamic programming then picks, among the best candidates of all
frames, the sequence of least matching cost plus turning: chosen frame by frame, some frame would start
flipped against its neighbour, and no weight of the temporal terms turns it back.
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
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig, joint_transforms, posed_keypoints
from jaxfit.model.pose import Pose, rest_pose
from jaxfit.model.rotation import matrix_to_axis_angle, unwrap_axis_angle, view_grid, viewing_axis_rotations

__all__ = ["candidate_orientations", "choose_sequence", "match_candidates", "search_initial_poses"]

SIGMA_PX = 30.0
"""Scale of the robust match: mean-pose keypoints lie this far off on a posed bird of 200 pixels."""
BLOCKED_RADIUS = np.pi / 4
"""Another hypothesis must differ by more than this angle."""


class Match(NamedTuple):
    """A candidate's scaled-orthographic fit to one frame's keypoints."""

    cost: Float[Array, "*B"]
    """Σ_i c_i · Geman-McClure of x and y, squared pixels."""
    scale_px: Float[Array, "*B"]
    """Pixels per model unit."""


def candidate_orientations(config: InitialiseConfig) -> Float[np.ndarray, "C 3 3"]:
    """Rotations model → camera to start from.

    Bird models have x to their side, y towards the bill and z up (dorsal). Seen from above, z points at
    the camera; the paper's candidates turn that view about the viewing axis in steps of 12°.
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
) -> Match:
    """Match every candidate orientation to one frame by scale and shift, robustly (4 reweightings).

    Returns:
        Costs and scales, (C,). Without any confident keypoint the costs are 0.
    """
    flat = jnp.einsum("cij,kj->cki", candidates[:, :2], model_keypoints)  # (C, K, 2)
    weight = jnp.broadcast_to(confidence, flat.shape[:2])
    for _ in range(4):
        scale, shift = _similarity(flat, keypoints_px, weight)
        squared = jnp.sum((scale[:, None, None] * flat + shift[:, None] - keypoints_px) ** 2, -1)
        weight = confidence * (SIGMA_PX**2 / (SIGMA_PX**2 + squared)) ** 2
    cost = jnp.sum(confidence * SIGMA_PX**2 * squared / (SIGMA_PX**2 + squared), axis=1)
    return Match(cost, scale)


def _similarity(flat, keypoints_px, weight):
    """Weighted least-squares scale (C,) and shift (C, 2) of orthographic points (C, K, 2) onto pixels."""
    total = jnp.maximum(jnp.sum(weight, axis=1), 1e-6)[:, None]
    mean_flat = jnp.sum(weight[..., None] * flat, axis=1) / total
    mean_px = jnp.sum(weight[..., None] * keypoints_px, axis=1) / total
    centred, target = flat - mean_flat[:, None], keypoints_px - mean_px[:, None]
    spread = jnp.maximum(jnp.sum(weight[..., None] * centred**2, axis=(1, 2)), 1e-6)
    # A bird is never a mirrored point: a candidate that wants a negative scale keeps a poor match.
    scale = jnp.maximum(jnp.sum(weight[..., None] * centred * target, axis=(1, 2)) / spread, 1e-2)
    return scale, mean_px - scale[:, None] * mean_flat


def choose_sequence(cost: Float[Array, "T M"], rotation: Float[Array, "T M 3 3"], smoothness: float) -> Int[Array, "T"]:
    """The candidate of each frame that minimises Σ_t cost + smoothness · Σ_t angle between neighbours.

    Exact, by dynamic programming (Viterbi); angles in radians.
    """

    def forward(best, current):
        cost_t, angle = current
        through = best[:, None] + smoothness * angle
        return cost_t + jnp.min(through, axis=0), jnp.argmin(through, axis=0)

    # cos θ = (tr(RaᵀRb) − 1) / 2: all pairs of neighbours in one product
    trace = jnp.einsum("tmij,tnij->tmn", rotation[:-1], rotation[1:])
    angles = jnp.arccos(jnp.clip((trace - 1) / 2, -1, 1))
    total, back = jax.lax.scan(forward, cost[0], (cost[1:], angles))
    last = jnp.argmin(total)
    _, before = jax.lax.scan(lambda at, pointers: (pointers[at], pointers[at]), last, back, reverse=True)
    return jnp.concatenate([before, last[None]])


def _orientations(
    candidates: Float[Array, "C 3 3"],
    model_keypoints: Float[Array, "K 3"],
    keypoints_px: Float[Array, "T K 2"],
    confidence: Float[Array, "T K"],
    config: InitialiseConfig,
) -> tuple[Float[Array, "H T 3 3"], Float[Array, "H T"]]:
    """Orientations and scales (pixels per model unit) of the H best distinct sequences of one window."""
    seen = jnp.any(confidence > 0, axis=1)
    frames = jnp.arange(len(seen))
    # a frame without keypoints takes the candidates of its nearest neighbour, at no cost
    nearest = jnp.argmin(jnp.abs(frames[:, None] - frames) + jnp.where(seen, 0, len(seen)), axis=1)
    match = jax.lax.map(lambda frame: match_candidates(candidates, model_keypoints, *frame), (keypoints_px, confidence))
    cost = match.cost[nearest]
    blocked = jnp.zeros_like(cost)
    orientations, scales = [], []
    for _ in range(config.hypotheses):
        _, index = jax.lax.top_k(-(cost + blocked), min(config.candidates, cost.shape[1]))
        unary = jnp.take_along_axis(cost + blocked, index, axis=1) * seen[:, None]
        path = choose_sequence(unary, candidates[index], config.smoothness)
        chosen = index[frames, path]
        orientations.append(candidates[chosen])
        scales.append(match.scale_px[nearest, chosen])
        trace = jnp.einsum("tij,cij->tc", candidates[chosen], candidates)
        blocked = jnp.where((trace - 1) / 2 > np.cos(BLOCKED_RADIUS), 1e9, blocked)
    return jnp.stack(orientations), jnp.stack(scales)


@partial(jax.jit, static_argnames=("config", "camera", "common_size"))
def search_initial_poses(
    bird: Bird,
    rig: Rig,
    keypoints_px: Float[Array, "W T K 2"],
    confidence: Float[Array, "W T K"],
    config: InitialiseConfig,
    camera: Camera,
    common_size: bool,
) -> Pose:
    """Starting poses of W windows: H hypotheses each, with the mean body pose, at a depth where scale ≈ 1.

    Args:
        bird, rig: the model, and the same folded.
        keypoints_px: crop pixels.
        confidence: 0 where a keypoint is missing; a frame without any follows its neighbour.
        config: candidates and hypotheses.
        camera: the crop camera.
        common_size: one scale for the window.

    Returns:
        A Pose with leading axes W, H, then T.

    Source: Hägerlind et al. 2024, initialisation, for the candidates; the choice over the window is ours.
    """
    frames = keypoints_px.shape[1]
    rest = rest_pose(bird)
    model_keypoints, root = posed_keypoints(rig, joint_transforms(rig, rest), rest), rig.joints[0]
    candidates = jnp.asarray(candidate_orientations(config), jnp.float32)

    def start(R, scale_px, keypoints_px, confidence) -> tuple[Array, Array, Array]:
        window_scale_px = jnp.median(scale_px)
        depth = camera.focal_px / window_scale_px
        scale = jnp.ones(1) if common_size else jnp.clip(scale_px / window_scale_px, 0.5, 2.0)
        # the bird turns about its root joint, as in `joint_transforms`
        turned = jnp.einsum("tij,kj->tki", R, model_keypoints - root) + root
        rotated = turned * scale[:, None, None]
        # the shift that brings the confident keypoints' mean onto the observed mean, at that depth
        weight = confidence[..., None] / jnp.maximum(jnp.sum(confidence, axis=1), 1e-6)[:, None, None]
        offset_px = jnp.sum(weight * (keypoints_px - camera.centre_px), axis=1)
        xy = offset_px * depth / camera.focal_px - jnp.sum(weight * rotated, axis=1)[:, :2]
        z = jnp.broadcast_to(depth - scale * root[2], (frames,))  # the root joint at this depth
        transl = jnp.concatenate([xy, z[:, None]], axis=-1)
        return unwrap_axis_angle(matrix_to_axis_angle(R)), transl, scale

    def window(seen: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        R, scale_px = _orientations(candidates, model_keypoints, *seen, config)
        return jax.vmap(start, (0, 0, None, None))(R, scale_px, *seen)

    at_once = max(1, 100 // frames)  # a window of 100 frames × 2,400 candidates takes some 100 MB
    orient, transl, scale = jax.lax.map(window, (keypoints_px, confidence), batch_size=at_once)
    whole = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*orient.shape[:2], *x.shape)), rest_pose(bird, frames, common_size)
    )
    return dataclasses.replace(whole, global_orient=orient, transl=transl, scale=scale)
