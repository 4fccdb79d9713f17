"""Initial poses, by a search over orientations or from a file.

Each candidate orientation of each frame has a matching cost: the robust distance between the detected keypoints and
the keypoints of the mean pose under a scaled orthographic camera (closed form). Dynamic programming then chooses one
of the best candidates in each frame, such that the sum of matching costs and rotations between frames is smallest. If
the frames were chosen independently, some frames would be flipped against their neighbours, and no weight of the
temporal terms corrects such a flip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfit.config.fit import InitialiseConfig
from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT, check_poses
from jaxfit.data.tracks import positions_in
from jaxfit.fitting.stored_programs import StoredProgram
from jaxfit.fitting.tiles import join_tiles, take_tile, tile_rows, tile_size
from jaxfit.fitting.windows import Windows
from jaxfit.foundation.array_files import load_npz, npz_names, validate_arrays
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera
from jaxfit.model.kinematics import Pose, Rig, joint_transforms, posed_keypoints, rest_pose
from jaxfit.model.rotation import matrix_to_axis_angle, unwrap_axis_angle, view_grid, viewing_axis_rotations

SIGMA_PX = 30.0
"""Scale of the robust matching cost, in pixels of a 256-pixel crop. On a bird of 200 pixels, the keypoints of the mean
pose are about this far from the keypoints of the true pose."""
MIN_SEPARATION_RAD = np.pi / 4
"""In every frame, the orientations of two hypotheses differ by more than this angle."""
MIN_SPAN = 0.1
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
    # scaled orthographic camera: pixel = s·(R·x)_xy + shift; a bird's depth is small beside its distance
    flat = jnp.einsum("cij,kj->cki", candidates[:, :2], model_keypoints)  # (C, K, 2)
    # iteratively reweighted least squares: the minimum of Σ c·ρ(e²) is that of Σ c·ρ′(e²)·e² with ρ′ at the last
    # errors, and ρ′(e²) = (σ²/(σ² + e²))² for Geman-McClure
    weight = jnp.broadcast_to(confidence, flat.shape[:2])
    for _ in range(4):
        scale, shift = _similarity(flat, keypoints_px, weight)
        squared = jnp.sum((scale[:, None, None] * flat + shift[:, None] - keypoints_px) ** 2, -1)
        weight = confidence * (SIGMA_PX**2 / (SIGMA_PX**2 + squared)) ** 2
    cost = jnp.sum(confidence * SIGMA_PX**2 * squared / (SIGMA_PX**2 + squared), axis=1)
    return OrthographicMatch(cost, scale)


def _similarity(flat, keypoints_px, weight):
    """Return the least-squares scale (C,) and shift (C, 2) from orthographic points (C, K, 2) to pixels."""
    # with the weighted means m of both: s = Σ w·(x − m_x)·(y − m_y) / Σ w·‖x − m_x‖², shift = m_y − s·m_x
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

    # Bellman: best_t+1(n) = cost_t+1(n) + min_m [best_t(m) + smoothness · angle(m, n)]. `predecessors` holds the
    # minimising m, so that the path is read backward from the best last candidate. It takes T·M² operations for M^T
    # paths.
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
    # Further hypotheses: the best sequence among candidates that are far from all earlier hypotheses in every frame.
    # Only the `candidates` best orientations of a frame take part, because the time grows with the square of their
    # number.
    exclusion = jnp.zeros_like(cost)
    orientations, scales = [], []
    for _ in range(config.hypotheses):
        _, index = jax.lax.top_k(-(cost + exclusion), min(config.candidates, cost.shape[1]))
        frame_cost = jnp.take_along_axis(cost + exclusion, index, axis=1) * has_keypoints[:, None]
        path = choose_sequence(frame_cost, candidates[index], config.smoothness)
        chosen = index[frames, path]
        orientations.append(candidates[chosen])
        scales.append(match.scale_px[nearest, chosen])
        trace = jnp.einsum("tij,cij->tc", candidates[chosen], candidates)  # tr(RaᵀRb) = 1 + 2 cos θ
        exclusion = jnp.where((trace - 1) / 2 > np.cos(MIN_SEPARATION_RAD), EXCLUDED_COST, exclusion)
    return jnp.stack(orientations), jnp.stack(scales)


def search_initial_poses(
    bird: Bird,
    rig: Rig,
    keypoints_px: Float[Array | np.ndarray, "W T K 2"],
    confidence: Float[Array | np.ndarray, "W T K"],
    config: InitialiseConfig,
    camera: CropCamera,
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
    orient, transl, scale = join_tiles(found, count)
    hypotheses = orient.shape[:2]
    rest = jax.tree.map(lambda x: np.broadcast_to(x, (*hypotheses, *np.shape(x))), rest_pose(bird, frames, common_size))
    return jax.device_put(replace(rest, global_orient=orient, transl=transl, scale=scale))


@partial(StoredProgram, structure=lambda *arguments: (0, 0, 0))
def _search_tile(
    bird: Bird,
    rig: Rig,
    keypoints_px: Float[Array, "G T K 2"],
    confidence: Float[Array, "G T K"],
    config: InitialiseConfig,
    camera: CropCamera,
    common_size: bool,
) -> tuple[Float[Array, "G H T 3"], Float[Array, "G H T 3"], Float[Array, "G H scales"]]:
    """Return orientation, translation and scale of the initial poses of the G windows of a tile."""
    frames = keypoints_px.shape[1]
    rest = rest_pose(bird)
    model_keypoints, root = posed_keypoints(rig, joint_transforms(rig, rest), rest), rig.joints[0]
    candidates = jnp.asarray(candidate_orientations(config), jnp.float32)
    # no orientation matches wrong keypoints well, so their scale is almost 0 and the depth would be extreme
    min_scale_px = MIN_SPAN * camera.size_px / jnp.ptp(model_keypoints, axis=0).max()

    def initial_pose(R, scale_px, keypoints_px, confidence) -> tuple[Array, Array, Array]:
        window_scale_px = jnp.maximum(jnp.median(scale_px), min_scale_px)
        # pixels per model unit = f·scale/z: the median frame has the size of the model, other frames keep their ratio
        # to it
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
    return jax.lax.map(search_window, (keypoints_px, confidence), batch_size=batch_size)


_FIELDS = ("global_orient", "body_pose", "transl", "scale", "bone_length", "betas", "crop")
_LAYOUT = {name: LAYOUT[name] for name in ("track_id", "frame_index", *_FIELDS)}
_REGRESSOR_LAYOUT = {
    "init_pose": ("A J 3", np.float32),
    "init_bone_length": ("A J-1", np.float32),
    "init_translation": ("A 3", np.float32),
}


@dataclass(frozen=True)
class InitialPoses:
    """Initial poses of the birds of one observations file, in the crop's camera frame; NaN in frames without a pose."""

    source: str
    """Name of the file, for error messages."""
    global_orient: Float[np.ndarray, "N T 3"]
    body_pose: Float[np.ndarray, "N T bones 3"]
    transl: Float[np.ndarray, "N T 3"]
    scale: Float[np.ndarray, "N T"]
    bone_length: Float[np.ndarray, "N T bones"]
    betas: Float[np.ndarray, "N T S"]
    crop: Float[np.ndarray, "N T 3"] | None = None
    """The crops of the poses, (x0, y0, size) in image pixels; None if the file does not contain crops."""

    @property
    def has_shape(self) -> bool:
        """Whether any shape coefficient is not zero."""
        return bool(np.any(np.nan_to_num(self.betas)))

    def check_crops(self, windows: Windows) -> None:
        """Check that every window has an initial pose, and that the poses refer to the crops of the window.

        Raises:
            InputError: a window has no initial pose, or the poses refer to other crops.
        """
        for n, track, frame, present, crop in zip(
            windows.track, windows.track_id, windows.frame, windows.present, windows.crop, strict=True
        ):
            has_pose = np.isfinite(self.global_orient[n, frame[present]]).all(-1)
            if not has_pose.any():
                problem = f"has no pose for track {track} in one of the windows of the track"
                raise InputError(self.source, problem, "every window needs the pose of at least one frame")
            if self.crop is not None:
                difference = np.abs(self.crop[n, frame[present]] - crop[present])[has_pose].max()
                if difference > 1:
                    raise InputError(
                        self.source,
                        f"`crop` of track {track} differs by {difference:.0f} pixels from the crop of this config",
                        "use the window and crop settings with which the file was written",
                    )

    def window_poses(self, bird: Bird, windows: Windows, common_size: bool) -> Pose:
        """Return the initial poses of W windows, with leading axes W, 1 (one hypothesis)."""
        poses = [
            self._window_pose(bird, n, frame, present, common_size)
            for n, frame, present in zip(windows.track.tolist(), windows.frame, windows.present, strict=True)
        ]
        return jax.tree.map(lambda *x: jnp.stack(x)[:, None], *poses)

    def _window_pose(
        self, bird: Bird, n: int, frame: Int[np.ndarray, "T"], present: Bool[np.ndarray, "T"], common_size: bool
    ) -> Pose:
        """Return the initial pose of one window. A frame without a pose has the pose of the nearest other frame."""
        has_pose = np.flatnonzero(present & np.isfinite(self.global_orient[n, frame]).all(-1))
        at = frame[has_pose[np.abs(np.arange(len(frame))[:, None] - has_pose).argmin(1)]]
        scale = self.scale[n, at]
        betas = np.median(self.betas[n, at], axis=0)[: bird.num_shapes]
        return Pose(
            global_orient=jnp.asarray(self.global_orient[n, at]),
            body_pose=jnp.asarray(self.body_pose[n, at]),
            transl=jnp.asarray(self.transl[n, at]),
            scale=jnp.asarray(np.median(scale, keepdims=True) if common_size else scale),
            bone_length=jnp.asarray(np.median(self.bone_length[n, at], axis=0)),
            betas=jnp.asarray(betas),
        )


def load_initial_poses(path: str | Path, observations: Observations, bird: Bird) -> InitialPoses:
    """Read initial poses for the birds of `observations`.

    The file has one of two layouts:

    - the arrays of the `poses.npz` of a result, matched by `track_id` and `frame_index`;
    - the output of a regressor, one row for each annotation, sorted by track and then by frame: `init_pose` (A, J, 3),
      `init_bone_length` (A, J−1), `init_translation` (A, 3).

    Raises:
        InputError: a damaged file, another layout, or poses that do not match the observations or the bird.
    """
    is_result = "global_orient" in npz_names(path)
    poses = _from_result(path, observations) if is_result else _from_regressor(path, observations)
    joints = poses.body_pose.shape[2] + 1
    if joints != bird.num_joints:
        raise InputError(path, f"has poses of {joints} joints", f"the model has {bird.num_joints} joints")
    if poses.betas.shape[2] not in (0, bird.num_shapes):
        problem = f"has {poses.betas.shape[2]} shape coefficients"
        raise InputError(path, problem, f"the model has {bird.num_shapes} shape coefficients")
    if poses.betas.shape[2] == 0:
        poses = replace(poses, betas=np.zeros((*poses.betas.shape[:2], bird.num_shapes), np.float32))
    return poses


def _from_result(path: str | Path, observations: Observations) -> InitialPoses:
    content = load_npz(path, {name: shape for name, (shape, _) in _LAYOUT.items()})
    try:
        content = validate_arrays(content, _LAYOUT)
        check_poses(content, np.asarray(np.isfinite(content["global_orient"]).all(axis=-1)))
    except ValueError as error:
        raise InputError(path, str(error), "use the poses.npz of a fit") from None
    rows = positions_in(observations.track_id, content["track_id"])
    columns = positions_in(observations.frame_index, content["frame_index"])
    missing = (rows < 0)[:, None] | (columns < 0)[None]
    if missing.all():
        raise InputError(path, "has no pose for any of these birds", "use initial poses of the same video")
    fields = {}
    for name in _FIELDS:
        fields[name] = content[name][np.ix_(rows, columns)]
        fields[name][missing] = np.nan
    return InitialPoses(str(path), **fields)


def _from_regressor(path: str | Path, observations: Observations) -> InitialPoses:
    content = load_npz(path, {name: shape for name, (shape, _) in _REGRESSOR_LAYOUT.items()})
    try:
        content = validate_arrays(content, _REGRESSOR_LAYOUT)
    except ValueError as error:
        raise InputError(path, str(error), "write one row for each annotation") from None
    pose, bone, transl = content.values()
    rows = int(observations.present.sum())
    if len(pose) != rows:
        problem = f"has {len(pose)} rows in `init_pose`, `init_bone_length`, `init_translation`"
        raise InputError(path, problem, f"the observations have {rows} annotations")
    if bone.shape[1] != pose.shape[1] - 1:
        problem = f"`init_pose` has {pose.shape[1]} joints, but `init_bone_length` has {bone.shape[1]} bones"
        raise InputError(path, problem, "expected (A, J, 3) and (A, J−1)")
    if not all(np.isfinite(a).all() for a in (pose, bone, transl)):
        raise InputError(path, "holds NaN or infinite numbers", "write finite numbers for all annotations")

    def by_track_and_frame(values):
        full = np.full((*observations.present.shape, *values.shape[1:]), np.nan, np.float32)
        full[observations.present] = values
        return full

    return InitialPoses(
        str(path),
        global_orient=by_track_and_frame(pose[:, 0]),
        body_pose=by_track_and_frame(pose[:, 1:]),
        transl=by_track_and_frame(transl),
        scale=by_track_and_frame(np.ones(rows)),
        bone_length=by_track_and_frame(bone),
        betas=by_track_and_frame(np.zeros((rows, 0))),
    )
