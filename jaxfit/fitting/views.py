"""`fit_views`: one pose of each bird in the world, from any number of calibrated cameras.

The poses are in model units, in a frame with the axes of the world and an origin near the birds. Every camera is an
affine map to the crop camera (`objective.posed_window.ViewMaps`), so that terms, solvers and kernels are those of one
view. Depth and size of the birds are estimated.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import Triangulated, triangulation_sd
from jaxfit.config.fit import FitConfig, Learnable, StageConfig
from jaxfit.data.flags import with_doubts_of_views
from jaxfit.data.observations import Observations
from jaxfit.data.projection import in_image
from jaxfit.data.solution import WORLD, Solution
from jaxfit.data.views import ViewKeypoints, Views, stacked_keypoints
from jaxfit.data.world import in_camera, in_world, whole_picture
from jaxfit.fitting.batch import FittedWindow
from jaxfit.fitting.bodies import Body, known_rows, with_bodies
from jaxfit.fitting.collect import blend_seams, frame_error_bars, gather_windows, pose_shapes
from jaxfit.fitting.error_bars import error_bar_shapes
from jaxfit.fitting.fit import check_observations, checked_model, fit
from jaxfit.fitting.initial_poses import InitialPoses
from jaxfit.fitting.ledge import metres
from jaxfit.fitting.solve import crop_camera, without_mask_stages
from jaxfit.fitting.tasks import FitTask, fit_windows
from jaxfit.fitting.windows import (
    Windows,
    prepare_observations,
    window_frames,
    window_starts,
    windows_at,
)
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX
from jaxfit.model.kinematics import fold_bird, rest_pose, window_keypoints, window_transforms
from jaxfit.model.rotation import unwrap_axis_angle
from jaxfit.objective.posed_window import ViewMaps

MIN_POINTS = 4
"""Triangulated keypoints of a frame that determine an orientation."""
MIN_SPREAD = 0.05
"""Smallest ratio of the second to the first extent of the triangulated keypoints: points on a line have no rotation."""
POSTURE_AXES, POSTURE_SDS = 3, (-3.0, -1.5, 1.5, 3.0)
"""Axes of the pose prior, with the largest variance first, and standard deviations of the initial body poses."""
POSTURE_FRAMES = 5
"""Consecutive frames whose keypoints choose the initial body pose of the frame in their middle."""
ROUNDS = 5
"""Rounds of reweighting of the alignment, and `ROBUST` its scale relative to the extent of the bird."""
ROBUST = 0.08
POSSIBLE_SIZES = 0.3, 3.0
"""Sizes relative to the model that a wrong unit or wrong calibration exceeds."""
POSSIBLE_LENGTHS_M = 0.03, 3.0
"""Lengths of birds that a wrong unit or wrong calibration exceeds."""
SIZE_PRIOR = "size_prior"

_logger = logging.getLogger(__name__)


def views_config(config: FitConfig, has_masks: bool) -> FitConfig:
    """Return a config for several views: depth and size are optimised, with the prior of the size.

    The silhouettes have an unbiased edge, and pixels that other birds may cover do not count. Nothing is learnt before
    the fit, because that is for one view.
    """
    used = config if has_masks else without_mask_stages(config)
    # a silhouette that is larger than its mesh, or a mask that another bird cuts, would bias the size
    used = replace(used, edge="unbiased", unknown_pixels=True)

    def free(stage: StageConfig) -> StageConfig:
        scales = {name: factor for name, factor in stage.step_scale.items() if name != "transl"}
        optimised = (*stage.optimised, *({"transl", "scale"} - set(stage.optimised)))
        terms = (*stage.terms, *({SIZE_PRIOR} - set(stage.terms)))
        return replace(stage, step_scale=scales, optimised=optimised, terms=terms)

    return replace(
        used,
        stages=tuple(free(stage) for stage in used.stages),
        learn_weights=() if used.learns_first else _learnt_with_bodies(used),
        initialise=replace(used.initialise, hypotheses=1),
    )


def _learnt_with_bodies(config: FitConfig) -> tuple[Learnable, ...]:
    """Return what a fit of several views learns: also the offsets of keypoints, which views tell from bones."""
    if not (config.learn_weights and config.can_learn_offsets):
        return config.learn_weights
    return tuple(dict.fromkeys((*config.learn_weights, "keypoint_offsets")))


def with_unit(views: Views, bird: Bird, source: object = "observations") -> Bird:
    """Return the model with its unit of length, which the cameras measure if the model has none.

    The measured unit is that with which the birds have the size of the model, in the median over birds and frames.

    Raises:
        InputError: there is only one view, no frame has enough keypoints, or the birds are longer or shorter than
            `POSSIBLE_LENGTHS_M`.
    """
    if bird.metres_per_unit is not None or len(views.cameras) < 2:
        return replace(bird, metres_per_unit=metres(bird))
    keypoints = stacked_keypoints([check_observations(own, bird, source) for own in views.observations])
    found = keypoints.triangulated(views.cameras)
    unit_m = float(np.nanmedian(_alignments(bird, found.points_world, _weights(keypoints, found), source).scale))
    extent = np.ptp(np.asarray(bird.vertices, np.float64), axis=0).max()
    if not POSSIBLE_LENGTHS_M[0] < unit_m * extent < POSSIBLE_LENGTHS_M[1]:
        problem = f"show birds of {unit_m * extent:.3g} m"
        raise InputError(source, problem, "check the unit of the cameras (--unit)")
    return replace(bird, metres_per_unit=unit_m)


def fit_views(
    views: Views,
    bird: Bird,
    config: FitConfig,
    progress: ProgressTask = silent,
    source: object = "observations",
    cluster: Cluster | None = None,
    bodies: Mapping[int, Body] | None = None,
) -> Solution:
    """Fit the poses of birds that several calibrated cameras see.

    Args:
        views: cameras and observations (`data.views`). A view may miss a bird, a frame, a mask or keypoints.
        bird: the model, with its unit of length (`with_unit`).
        config: the config of a fit, as for one view.
        progress: shows progress.
        source: name of the observations in error messages.
        cluster: worker processes that fit the windows.
        bodies: track id → known body of a bird, as for `fit`.

    Returns:
        Poses in the frame of the first camera without distortion, whose crop is the whole picture, in the world
        (`data.solution.World`). With one view: the result of `fit`; in the world, every bird has the size of the model.

    Raises:
        InputError: no bird that two cameras see, a model without a unit, or a size that shows a wrong unit.
    """
    unit_m = metres(bird)
    checked = [check_observations(own, bird, source) for own in views.observations]
    if len(checked) == 1:
        solution = fit(checked[0], bird, config, None, progress, source, cluster=cluster, bodies=bodies)
        return _with_world(solution, bird, views.cameras[0])
    config = views_config(config, any(own.masks for own in checked))
    prepared = [prepare_observations(own, config) for own in checked]
    keypoints = stacked_keypoints(prepared)
    found = keypoints.triangulated(views.cameras)
    if not np.isfinite(found.points_world).any():
        problem = "show no bird in two cameras whose keypoints agree"
        raise InputError(source, problem, "see `jaxfit cameras check`, and check the order of the cameras")
    origin_m = np.nanmedian(found.points_world.reshape(-1, 3), axis=0)
    points = (found.points_world - origin_m) / unit_m
    initial = initial_poses(bird, points, _weights(keypoints, found), source)
    has_pose = np.asarray(np.isfinite(initial.global_orient).all(-1))
    windows = view_windows(views.cameras, prepared, config, origin_m, unit_m, points, has_pose, source)
    model = checked_model(prepared[0], bird, [config], initial, source)
    task = FitTask([config], [windows], [(0, w) for w in range(len(windows))])
    subject = f"{prepared[0].num_tracks} birds × {len(views.cameras)} views"
    known = known_rows(bodies, prepared[0].track_id)
    birds = prepared[0].num_tracks
    results, (estimated,) = fit_windows(task, model, birds, subject, progress, cluster=cluster, known=known)
    fitted = [results[problem] for problem in task.problems]
    if config.overlap_frames:
        fitted = blend_seams(windows, fitted, model)
    skipped = without_orientation(prepared[0], points, has_pose)
    solution = _solution(views, prepared[0], windows, fitted, bird, origin_m, unit_m, skipped)
    sd_m = triangulation_sd(views.cameras, found, keypoints.confidence)
    solution = solution.with_arrays(keypoints_triangulated_m=found.points_world, keypoints_triangulated_sd_m=sd_m)
    if estimated:
        solution = with_bodies(solution, estimated, bird, config, source)
    seen = ((in_camera(solution, bird, camera), own) for camera, own in zip(views.cameras, checked, strict=True))
    return with_doubts_of_views(solution, seen, bird, progress)


def without_orientation(
    observations: Observations, points: Float[np.ndarray, "N T K 3"], has_pose: Bool[np.ndarray, "N T"]
) -> dict[int, tuple[str, ...]]:
    """Return track → text about a bird without any initial pose, as `Solution.failures`, and log a warning for each."""
    enough = (np.isfinite(points).all(-1).sum(-1) >= MIN_POINTS).sum(-1)
    texts = {}
    for n in np.flatnonzero(~has_pose.any(-1)).tolist():
        text = f"no frame has {MIN_POINTS} keypoints that two cameras agree on"
        if enough[n]:
            text = f"in {enough[n]} frames, the keypoints are too close to a line, so its orientation is unknown"
        track = int(observations.track_id[n])
        _logger.warning("bird %d is not fitted: %s", track, text)
        texts[track] = (f"not fitted: {text}",)
    return texts


def _weights(keypoints: ViewKeypoints, found: Triangulated) -> Float[np.ndarray, "N T K"]:
    """Return the weight of each triangulated keypoint: the mean confidence of the views that agree."""
    agree = found.agrees.sum(axis=0)
    # in the precision of the observations
    mean = (keypoints.confidence.astype(np.float32) * found.agrees).sum(axis=0) / np.maximum(agree, 1)
    return np.where(np.isfinite(found.points_world).all(-1), mean, 0)


def initial_poses(
    bird: Bird, points: Float[np.ndarray, "N T K 3"], weight: Float[np.ndarray, "N T K"], source: object
) -> InitialPoses:
    """Return initial poses: that of some postures of the prior which agrees best with the keypoints of each frame.

    The size of a bird is the median over its frames. Frames whose keypoints do not determine the orientation have no
    pose (NaN).

    Args:
        bird: the model.
        points: triangulated keypoints, model units, NaN where unknown.
        weight: weight of each keypoint, 0 where unknown.
        source: name of the observations in error messages.

    Raises:
        InputError: a size that shows a wrong unit of length, or no frame with enough keypoints.

    Source: Umeyama 1991, *Least-squares estimation of transformation parameters between two point patterns*.
    """
    R, scale, body_pose, shape = _alignments(bird, points, weight, source)
    rest, root = rest_pose(bird), np.asarray(bird.joints[0], np.float64)
    N, T = weight.shape[:2]
    transl = np.full((N, T, 3), np.nan)
    overall = float(np.nanmedian(scale))
    if not POSSIBLE_SIZES[0] < overall < POSSIBLE_SIZES[1]:
        problem = f"show birds of {overall:.3g} × the size of the model"
        raise InputError(
            source, problem, "check the unit of the cameras (--unit), and that the model is of your species"
        )
    orient = np.full((N, T, 3), np.nan)
    for n in range(N):
        known = np.isfinite(scale[n])
        size = np.nanmedian(scale[n]) if known.any() else 1.0
        scale[n] = size
        for t in np.flatnonzero(known).tolist():
            w = weight[n, t][:, None]
            posed = size * ((shape[n, t] - root) @ R[n, t].T + root)
            transl[n, t] = (w * (np.nan_to_num(points[n, t]) - posed)).sum(0) / w.sum()
        if known.any():
            rotations = Rotation.from_matrix(R[n, known]).as_rotvec()
            orient[n, known] = np.asarray(unwrap_axis_angle(jnp.asarray(rotations, jnp.float32)))
    bones, shapes = bird.num_joints - 1, bird.num_shapes

    def everywhere(values: Any, *axes: int) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.float32), (N, T, *axes))

    return InitialPoses(
        str(source),
        global_orient=orient.astype(np.float32),
        body_pose=body_pose.astype(np.float32),
        transl=transl.astype(np.float32),
        scale=scale.astype(np.float32),
        bone_length=everywhere(rest.bone_length, bones),
        betas=everywhere(0, shapes),
    )


class _Aligned(NamedTuple):
    """The posture that agrees best with the keypoints of each bird and frame, and its place; NaN if not determined."""

    R: Float[np.ndarray, "N T 3 3"]
    scale: Float[np.ndarray, "N T"]
    body_pose: Float[np.ndarray, "N T bones 3"]
    keypoints: Float[np.ndarray, "N T K 3"]
    """The keypoints of the posture, without rotation."""


def _alignments(
    bird: Bird, points: Float[np.ndarray, "N T K 3"], weight: Float[np.ndarray, "N T K"], source: object
) -> _Aligned:
    """Align postures with the keypoints of each frame, and return the best; the mean pose where nothing is known.

    Raises:
        InputError: no frame has enough keypoints.
    """
    body_pose, keypoints, cost = _postures(bird)
    known = (weight > 0).sum(-1) >= MIN_POINTS
    found = [_align(shape, np.nan_to_num(points[known]), weight[known]) for shape in keypoints]
    R, scale, error = (np.stack(each) for each in zip(*found, strict=True))
    errors = np.zeros((len(cost), *known.shape))
    errors[:, known] = error
    # a bird hardly changes its posture from frame to frame: some frames share the cost of one posture
    together = POSTURE_FRAMES * uniform_filter1d(errors, POSTURE_FRAMES, axis=-1, mode="constant")[:, known]
    best = np.argmin(together + cost[:, None], axis=0)
    at = best, np.arange(len(best))
    aligned = _Aligned(
        np.full((*known.shape, 3, 3), np.nan),
        np.full(known.shape, np.nan),
        np.broadcast_to(body_pose[0], (*known.shape, *body_pose.shape[1:])).copy(),
        np.broadcast_to(keypoints[0], (*known.shape, *keypoints.shape[1:])).copy(),
    )
    for whole, values in zip(aligned, (R[at], scale[at], body_pose[best], keypoints[best]), strict=True):
        whole[known] = values
    if not np.isfinite(aligned.scale).any():
        problem = f"have no frame with {MIN_POINTS} keypoints of a bird in two cameras"
        raise InputError(source, problem, "see `jaxfit cameras check`")
    return aligned


def _postures(bird: Bird) -> tuple[Float[np.ndarray, "C bones 3"], Float[np.ndarray, "C K 3"], Float[np.ndarray, "C"]]:
    """Return body poses along the first axes of the pose prior, their keypoints, and their costs in nats.

    A bird with spread wings is far from the mean pose: aligned with it, the wings turn the body, and the head of the
    fit stays in a local minimum.
    """
    variance, axes = np.linalg.eigh(np.asarray(bird.pose_covariance, np.float64))
    leading = (axes * np.sqrt(np.maximum(variance, 0)))[:, ::-1][:, :POSTURE_AXES].T
    z = np.concatenate([np.zeros((1, len(leading))), np.kron(np.eye(len(leading)), np.array([POSTURE_SDS]).T)])
    rig, rest = fold_bird(bird), rest_pose(bird, len(z))
    body_pose = np.asarray(rest.body_pose) + (z @ leading).reshape(rest.body_pose.shape)
    pose = replace(rest, body_pose=jnp.asarray(body_pose, jnp.float32))
    keypoints = window_keypoints(rig, window_transforms(rig, pose), pose)
    return body_pose, np.asarray(keypoints, np.float64), (z**2).sum(axis=1) / 2


def _align(
    shape: Float[np.ndarray, "K 3"], points: Float[np.ndarray, "M K 3"], weight: Float[np.ndarray, "M K"]
) -> tuple[Float[np.ndarray, "M 3 3"], Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Return rotations, scales and costs that align a shape with points; outliers lose weight. NaN: points on a line.

    The cost is that of Cauchy errors with the scale `ROBUST`, in nats.
    """
    w, extent = weight, np.ptp(shape, axis=0).max()
    for round_ in range(ROUNDS):
        share = w / w.sum(-1, keepdims=True)
        a, b = shape - (share @ shape)[:, None], points - np.einsum("mk,mkc->mc", share, points)[:, None]
        if not round_:
            extents = np.linalg.svd(np.sqrt(share)[..., None] * b, compute_uv=False)
            line = extents[:, 1] <= MIN_SPREAD * extents[:, 0]
        U, S, Vt = np.linalg.svd(np.einsum("mk,mkc,mkd->mcd", share, b, a))
        D = np.ones_like(S)
        D[:, 2] = np.sign(np.linalg.det(U @ Vt))
        R = (U * D[:, None]) @ Vt
        scale = (S * D).sum(-1) / np.einsum("mk,mkc->m", share, a**2)
        error = np.linalg.norm(b - scale[:, None, None] * a @ R.swapaxes(1, 2), axis=-1)
        error = error / np.maximum(ROBUST * extent * scale, 1e-12)[:, None]
        w = weight / (1 + error**2) ** 2
    cost = (weight * np.log1p(error**2)).sum(-1)
    R[line], scale[line] = np.nan, np.nan
    return R, scale, cost


def view_windows(
    cameras: Sequence[Camera],
    prepared: Sequence[Observations],
    config: FitConfig,
    origin_m: Float[np.ndarray, "3"],
    unit_m: float,
    points: Float[np.ndarray, "N T K 3"],
    has_pose: Bool[np.ndarray, "N T"],
    source: object,
) -> Windows:
    """Cut the observations of all views into common windows. Windows without an initial pose are left out.

    Raises:
        InputError: no window is left.
    """
    each = replace(config, min_keypoints=1)  # two keypoints of a view count, if the other views see more
    confidence = np.stack([own.confidence for own in prepared])
    together = replace(
        prepared[0],
        present=np.any([own.present for own in prepared], axis=0),
        confidence=confidence.max(axis=0),
        masks={},
    )
    starts = window_starts(together, config)
    frame = window_frames(together, config, starts)
    posed = has_pose & together.usable(config.min_keypoints)
    starts = starts[((frame >= 0) & posed[starts[:, :1], np.maximum(frame, 0)]).any(axis=1)]
    if not len(starts):
        problem = f"have no bird with {config.min_keypoints} keypoints in two cameras"
        raise InputError(source, problem, "see `jaxfit cameras check`, or lower `min_keypoints` in the config")
    views = [windows_at(own, each, starts) for own in prepared]
    first = views[0]
    usable = together.usable(config.min_keypoints)
    present = (first.frame >= 0) & usable[starts[:, :1], np.maximum(first.frame, 0)]
    maps = [_view_map(camera, own, config, origin_m, unit_m) for camera, own in zip(cameras, views, strict=True)]
    linear, offset = (np.stack(each, axis=2).astype(np.float32) for each in zip(*maps, strict=True))
    seen = np.stack([own.present & present for own in views], axis=2)
    masks = np.empty((len(starts), len(views)), object)
    for v, own in enumerate(views):
        masks[:, v] = own.masks
    return Windows(
        track=first.track,
        track_id=first.track_id,
        frame=first.frame,
        present=present,
        crop=np.stack([own.crop for own in views], axis=2),
        keypoints_px=np.concatenate([own.keypoints_px for own in views], axis=2),
        confidence=np.concatenate([own.confidence * present[..., None] for own in views], axis=2),
        has_mask=np.stack([own.has_mask for own in views], axis=2) & seen,
        masks=masks,
        frame_s=first.frame_s,
        views=ViewMaps(linear, offset, _px_per_unit(linear, offset, seen, points, first, config).astype(np.float32)),
    )


def _view_map(
    camera: Camera, windows: Windows, config: FitConfig, origin_m: np.ndarray, unit_m: float
) -> tuple[Float[np.ndarray, "W T 3 3"], Float[np.ndarray, "W T 3"]]:
    """Return L and o of `ViewMaps` for the crops of the windows of one camera."""
    crop_cam = crop_camera(config)
    scale = CROP_PX / windows.crop[..., 2]
    K = np.zeros((*windows.frame.shape, 3, 3))
    K[..., :2, :] = camera.matrix[:2] * scale[..., None, None]
    K[..., :2, 2] -= windows.crop[..., :2] * scale[..., None]
    K[..., :2, 2] -= crop_cam.centre_px
    K[..., :2, :] /= crop_cam.focal_px
    K[..., 2, 2] = 1
    t = (camera.R_cam_world @ origin_m + camera.transl_cam) / unit_m
    return K @ camera.R_cam_world, K @ t


def _px_per_unit(
    linear: np.ndarray, offset: np.ndarray, seen: np.ndarray, points: np.ndarray, windows: Windows, config: FitConfig
) -> Float[np.ndarray, "W"]:
    """Return the mean crop pixels of a model unit at the birds, over the frames and views that see them."""
    at = np.maximum(windows.frame, 0)
    own = points[windows.track[:, None], at]
    known = np.isfinite(own).all(-1).any(-1)
    centre = np.full((*known.shape, 3), np.nan)
    centre[known] = np.nanmedian(own[known], axis=1)
    depth = np.einsum("wtvj,wtj->wtv", linear[..., 2, :], centre) + offset[..., 2]
    focal = crop_camera(config).focal_px * np.linalg.norm(np.cross(linear[..., 0, :], linear[..., 2, :]), axis=-1)
    px = np.where(seen & (depth > 0), focal / np.where(depth > 0, depth, 1), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        mean = np.nanmean(px.reshape(len(px), -1), axis=1)
    return np.where(np.isfinite(mean), mean, 10.0)


def _solution(
    views: Views,
    first: Observations,
    windows: Windows,
    results: list[FittedWindow],
    bird: Bird,
    origin_m: np.ndarray,
    unit_m: float,
    skipped: Mapping[int, tuple[str, ...]],
) -> Solution:
    """Return the poses of all windows, in the frame of the first camera and in the world."""
    camera, cells = views.lenses[0], (first.num_tracks, first.num_frames)
    shapes = pose_shapes(bird)
    if any(result.error_bars is not None for result in results):
        shapes |= error_bar_shapes(bird.num_joints - 1, bird.num_shapes, bird.num_keypoints)
    arrays = {name: np.full((*cells, *shape), np.nan, np.float32) for name, shape in shapes.items()}
    sizes = {"3": 3, "K": bird.num_keypoints}
    for name, (shape, dtype) in WORLD.items():
        arrays[name] = np.full((*cells, *(sizes[axis] for axis in shape.split()[2:])), np.nan, dtype)

    def values_of(result: FittedWindow, w: int) -> dict[str, Any]:
        crop = np.asarray(windows.crop[w][:, 0])[windows.present[w]]
        values = _frame_values(result, windows.present[w], bird, camera, origin_m, unit_m)
        return values | _frame_error_bars(result, windows.present[w], crop, bird, camera)

    gathered = gather_windows(first, windows, results, arrays, values_of, skipped)
    width, height = first.image_size_px[0].tolist()
    crops = whole_picture(camera, gathered["valid"], (width, height))
    return Solution.from_arrays(
        **gathered,
        crop=crops.square_px,
        image_size_px=crops.image_size_px,
        focal_px=crops.focal_px,
        crop_px=crops.crop_px,
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
    )


def _frame_values(
    result: FittedWindow,
    present: Bool[np.ndarray, "T"],
    bird: Bird,
    camera: Camera,
    origin_m: Float[np.ndarray, "3"],
    unit_m: float,
) -> dict[str, Any]:
    """Return the arrays of a solution at the present frames of one window."""
    pose, root, R_cam_world = result.pose, np.asarray(bird.joints[0], np.float64), camera.R_cam_world
    t_cam = (R_cam_world @ origin_m + camera.transl_cam) / unit_m
    scale = np.broadcast_to(pose.scale, present.shape)[present]
    R_world = Rotation.from_rotvec(np.asarray(pose.global_orient, np.float64)[present])
    orient_cam = (Rotation.from_matrix(R_cam_world) * R_world).as_rotvec()
    place = np.asarray(pose.transl, np.float64)[present] + scale[:, None] * root
    keypoints = np.asarray(result.keypoints_cam, np.float64)[present]
    betas = np.zeros(bird.num_shapes)
    betas[: len(pose.betas)] = pose.betas
    return {
        "global_orient": np.asarray(unwrap_axis_angle(jnp.asarray(orient_cam, jnp.float32))),
        "body_pose": np.asarray(pose.body_pose)[present],
        "transl": place @ R_cam_world.T + t_cam - scale[:, None] * root,
        "scale": scale,
        "bone_length": pose.bone_length,
        "betas": betas,
        "keypoints_cam": keypoints @ R_cam_world.T + t_cam,
        "keypoints_px": np.nan_to_num(camera.project(keypoints * unit_m + origin_m)),
        "R_world_root": R_world.as_matrix(),
        "transl_world_m": place * unit_m + origin_m,
        "keypoints_world_m": keypoints * unit_m + origin_m,
    }


def _frame_error_bars(
    result: FittedWindow,
    present: Bool[np.ndarray, "T"],
    crop: Float[np.ndarray, "M 3"],
    bird: Bird,
    camera: Camera,
) -> dict[str, Any]:
    """Return the error bars of a solution at the present frames of one window, in the frame of the first camera."""
    values = frame_error_bars(result.error_bars, crop, present, bird, CROP_PX)
    for name in ("keypoints_cam_cov", "keypoints_centred_cov"):
        if name in values:
            values[name] = camera.R_cam_world @ values[name] @ camera.R_cam_world.T
    return values


def _with_world(solution: Solution, bird: Bird, camera: Camera) -> Solution:
    """Return the solution of one view with the birds in the world: every bird has the size of the model."""
    unit_m = bird.metres_per_unit or 1.0
    placed = in_image(solution, bird, float(camera.matrix[0, 0]), tuple(camera.matrix[:2, 2]))
    keypoints_cam = placed.points(
        solution.keypoints.cam.astype(np.float64), np.asarray(solution.poses.scale, np.float64)
    )
    return replace(solution, world=in_world(camera, unit_m, placed.orientation, placed.root, keypoints_cam))
