"""Fitted windows → `Solution` with statuses, blended seams, and `summary.json`.

Seams: windows of one track share frames, and the poses of these frames pass from one window to the next. The windows
are fitted independently. In the shared frames, the weight w of the later window rises linearly from 0 to 1. Rotations
are blended on SO(3): R = Ra exp(w log(Raᵀ Rb)). The position of the root joint in the image and the logarithm of the
apparent size are blended linearly, because the crops of the two windows differ.
"""

from __future__ import annotations

import logging
import platform
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.data.body_lengths import body_lengths
from jaxfit.data.flags import flag_counts, flagged_ranges
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.fitting.batch import FittedWindow
from jaxfit.fitting.error_bars import ErrorBars, blend_error_bars, error_bar_shapes
from jaxfit.fitting.solve import FitModel
from jaxfit.fitting.windows import Windows
from jaxfit.foundation.extras import LIBRARIES, library_versions
from jaxfit.model.bird import Bird, model_hash
from jaxfit.model.camera import CropCamera, crop_to_image, image_to_crop, project
from jaxfit.model.kinematics import Pose, Rig, window_keypoints, window_transforms
from jaxfit.model.rotation import axis_angle_to_matrix, matrix_to_axis_angle, unwrap_axis_angle

_logger = logging.getLogger(__name__)


def collect_windows(
    observations: Observations,
    windows: Windows,
    results: list[FittedWindow],
    bird: Bird,
    camera: CropCamera,
    common_size: bool,
    skipped: Mapping[int, tuple[str, ...]],
) -> Solution:
    """Return the solution of one run.

    One camera cannot distinguish a small near bird from a large distant bird: a factor on size and position does not
    change the projection, and the factors of fitted windows are arbitrary. Where the frames of a window share one size,
    every bird therefore gets the size of the model, so that it has one size in the whole video.

    A window diverges or does not diverge by itself. Only windows that did not diverge have valid poses and contribute
    to the loss. The status of a track summarises its windows: `ok` (no window diverged), `partly diverged`, `diverged`
    (all windows diverged) or `no usable frame` (the track has no window).

    Args:
        observations: the observations that the windows were cut from.
        windows: W windows.
        results: the result of each window. The list is emptied, so that results and solution never lie in memory
            together.
        bird: the model.
        camera: the crop camera.
        common_size: as in the config.
        skipped: track → text about its skipped frames, for `Solution.failures`.
    """
    birds, frames = observations.num_tracks, observations.num_frames
    arrays = _empty_frame_values(birds, frames, bird, any(result.error_bars is not None for result in results))

    def values_of(result: FittedWindow, w: int) -> dict[str, Any]:
        return _frame_values(result, windows.crop[w], windows.present[w], bird, camera, common_size)

    gathered = gather_windows(observations, windows, results, arrays, values_of, skipped)
    image_size_px = np.zeros((birds, frames, 2), np.int64)
    for n, t in np.argwhere(gathered["valid"]).tolist():
        image_size_px[n, t] = observations.image_size(n, t)
    image_size_px.flags.writeable = False  # so that `Solution` needs no copy
    return Solution.from_arrays(
        **gathered,
        image_size_px=image_size_px,
        focal_px=camera.focal_px,
        crop_px=camera.size_px,
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
    )


def gather_windows(
    observations: Observations,
    windows: Windows,
    results: list[FittedWindow],
    arrays: dict[str, Any],
    values_of: Callable[[FittedWindow, int], dict[str, Any]],
    skipped: Mapping[int, tuple[str, ...]],
) -> dict[str, Any]:
    """Return the fields of a solution that come from its windows and observations, and not from the camera.

    Args:
        observations, windows, results, skipped: as for `collect_windows`. The list `results` is emptied.
        arrays: the arrays that `values_of` fills, for all birds and frames, NaN. They become read-only.
        values_of: returns the arrays at the present frames of a fitted window, from its result and its row.
    """
    birds = observations.num_tracks
    valid = np.zeros((birds, observations.num_frames), bool)
    fitted, diverged = np.zeros(birds, int), np.zeros(birds, int)
    loss = {name: np.full(birds, np.nan) for name in results[0].loss}
    failures = dict(skipped)
    results.reverse()
    for w in range(len(results)):
        result = results.pop()
        n, at = int(windows.track[w]), windows.frame[w][windows.present[w]]
        if result.failure:
            diverged[n] += 1
            first, last = observations.frame_index[at[[0, -1]]]
            track, text = int(windows.track_id[w]), f"frames {first} to {last}: {result.failure}"
            _logger.warning("track %d, %s", track, text)
            failures[track] = (*failures.get(track, ()), text)
            continue
        for name, value in result.loss.items():
            loss[name][n] = value + (loss[name][n] if fitted[n] else 0.0)
        fitted[n] += 1
        valid[n, at] = True
        for name, value in values_of(result, w).items():
            arrays[name][n, at] = value
    for array in (valid, *arrays.values()):
        array.flags.writeable = False  # so that `Solution` needs no copy
    counts = zip(fitted.tolist(), diverged.tolist(), strict=True)
    return arrays | {
        "track_id": observations.track_id,
        "frame_index": observations.frame_index,
        "valid": valid,
        "loss": loss,
        "status": np.array([track_status(*count) for count in counts], "<U32"),
        "failures": failures,
        "timestamp_s": observations.timestamp_s,
        "fps": observations.fps,
        "footage": observations.footage,
    }


def _empty_frame_values(birds: int, frames: int, bird: Bird, error_bars: bool) -> dict[str, Any]:
    """Return the arrays that `_frame_values` fills, for all birds and frames; NaN."""
    bars = error_bar_shapes(bird.num_joints - 1, bird.num_shapes, bird.num_keypoints) if error_bars else {}
    shapes = pose_shapes(bird) | {"crop": (3,), "ambiguity_deg": ()} | bars
    return {name: np.full((birds, frames, *shape), np.nan, np.float32) for name, shape in shapes.items()}


def pose_shapes(bird: Bird) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of a pose and of its keypoints, in one frame."""
    bones, keypoints = bird.num_joints - 1, bird.num_keypoints
    return {
        "global_orient": (3,),
        "body_pose": (bones, 3),
        "transl": (3,),
        "scale": (),
        "bone_length": (bones,),
        "betas": (bird.num_shapes,),
        "keypoints_cam": (keypoints, 3),
        "keypoints_px": (keypoints, 2),
    }


def _frame_values(
    result: FittedWindow, crop: np.ndarray, present: np.ndarray, bird: Bird, camera: CropCamera, common_size: bool
) -> dict[str, Any]:
    """Return the arrays of a solution at the present frames of one window."""
    pose, crop = result.pose, crop[present].astype(np.float32)
    betas = np.zeros(bird.num_shapes, np.float32)  # for a fit without shape coefficients
    betas[: len(pose.betas)] = pose.betas
    scale = np.broadcast_to(pose.scale, present.shape)[present]
    factor = scale if common_size else np.ones_like(scale)
    return {
        "global_orient": pose.global_orient[present],
        "body_pose": pose.body_pose[present],
        "transl": pose.transl[present] / factor[:, None],
        "scale": scale / factor,
        "bone_length": pose.bone_length,
        "betas": betas,
        "keypoints_cam": result.keypoints_cam[present] / factor[:, None, None],
        "keypoints_px": crop_to_image(result.keypoints_px[present], crop, camera.size_px),
        "crop": crop,
        "ambiguity_deg": result.ambiguity_deg[present],
        **frame_error_bars(result.error_bars, crop, present, bird, camera.size_px),
    }


def frame_error_bars(
    bars: ErrorBars | None, crop: np.ndarray, present: np.ndarray, bird: Bird, crop_px: int
) -> dict[str, Any]:
    """Return the error bars of a solution at the present frames of one window; `crop` is that of these frames."""
    if bars is None:
        return {}
    values = {name: value[present] for name, value in bars._asdict().items()}
    missing = bird.num_shapes - bars.betas_sd.shape[1]  # a fit without shape coefficients
    values["betas_sd"] = np.pad(values["betas_sd"], ((0, 0), (0, missing)))
    values["keypoints_px_cov"] = values["keypoints_px_cov"] * (crop[:, 2, None, None, None] / crop_px) ** 2
    return values


def track_status(fitted: int, diverged: int) -> str:
    """Return the status of a track from its numbers of fitted and diverged windows."""
    if fitted and diverged:
        return "partly diverged"
    return "ok" if fitted else "diverged" if diverged else "no usable frame"


LARGEST_ANGLE = np.pi / 2
"""Windows whose orientations differ by a larger angle in a shared frame are not blended: one of them is flipped."""


def shared_frames(windows: Windows, w: int) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Return the positions in window w − 1 and in window w of the frames that both have; none for the first window."""
    if w == 0 or windows.track[w - 1] != windows.track[w]:
        return np.zeros(0, int), np.zeros(0, int)
    before, own = (np.where(windows.present[i], windows.frame[i], -1 - i) for i in (w - 1, w))
    _, at_before, at_own = np.intersect1d(before, own, return_indices=True)
    is_frame = own[at_own] >= 0
    return at_before[is_frame], at_own[is_frame]


def blend_seams(windows: Windows, results: Sequence[FittedWindow], model: FitModel) -> list[FittedWindow]:
    """Return the results with blended poses in the first shared frames of every window.

    The poses of the shared frames in the earlier window do not change. If the orientations of the two windows differ by
    more than 90° in a shared frame, the first half of the shared frames has the poses of the earlier window, and the
    second half those of the later window. A window that diverged has no part in a seam. The lengths of bones and the
    shape coefficients are those of the later window. Error bars: `blend_error_bars`.

    Args:
        windows: W windows, by track and time. A frame is in at most two windows.
        results: the result of every window.
        model: the bird and the crop camera.
    """
    blended = list(results)
    for w in range(1, len(windows)):
        at_before, at_own = shared_frames(windows, w)
        if len(at_own) and not (results[w - 1].failure or results[w].failure):
            blended[w] = _blend(windows, results[w - 1], results[w], w, at_before, at_own, model)
    return blended


def _blend(
    windows: Windows, before: FittedWindow, own: FittedWindow, w: int, at_before, at_own, model: FitModel
) -> FittedWindow:
    """Return the result of window w with blended poses in its frames `at_own`."""
    earlier, later = (
        _in_image(result.pose, _crops(windows, i), at, model)
        for result, i, at in ((before, w - 1, at_before), (own, w, at_own))
    )
    weight = (np.arange(len(at_own)) + 1) / (len(at_own) + 1)
    R_before, R_own = (axis_angle_to_matrix(jnp.asarray(each.rotations)) for each in (earlier, later))
    turn = matrix_to_axis_angle(jnp.swapaxes(R_before, -1, -2) @ R_own)
    if np.linalg.norm(turn[:, 0], axis=-1).max() > LARGEST_ANGLE:
        weight = np.round(weight)
    R = R_before @ axis_angle_to_matrix(turn * jnp.asarray(weight, jnp.float32)[:, None, None])
    rotations = np.asarray(_nearest_axis_angle(jnp.asarray(later.rotations), matrix_to_axis_angle(R)))
    root = earlier.root + weight[:, None] * (later.root - earlier.root)
    size = earlier.size * (later.size / earlier.size) ** weight
    blended = _with_poses(own, _crops(windows, w), at_own, _InImage(rotations, root, size, later.depth), model)
    if before.error_bars is None or own.error_bars is None:
        return blended
    ratio = _first_crops(windows, w - 1)[at_before, 2] / _first_crops(windows, w)[at_own, 2]
    return blended._replace(
        error_bars=blend_error_bars(before.error_bars, own.error_bars, at_before, at_own, weight, ratio)
    )


class _InImage(NamedTuple):
    """Poses of m frames, without the crop of their window."""

    rotations: Float[np.ndarray, "m J 3"]
    """Axis-angle of the root and of the other joints."""
    root: Float[np.ndarray, "m axes"]
    """Root joint: image pixels (2 axes), or model units of the frame that several views share (3 axes)."""
    size: Float[np.ndarray, "m"]
    """Image pixels per model unit at the root; with several views, the size relative to the model."""
    depth: Float[np.ndarray, "m"]
    """Depth of the root in the crop camera, model units."""


def _crops(windows: Windows, w: int) -> Float[np.ndarray, "T 3"] | None:
    """Return the crops of a window of one view; None for several views, whose poses are in no crop."""
    return None if windows.views is not None else windows.crop[w]


def _first_crops(windows: Windows, w: int) -> Float[np.ndarray, "T 3"]:
    """Return the crops of a window in its first view."""
    return windows.crop[w].reshape(windows.crop.shape[1], -1, 3)[:, 0]


def _in_image(pose: Pose, crop: np.ndarray | None, at: np.ndarray, model: FitModel) -> _InImage:
    scale = np.broadcast_to(pose.scale, len(pose.transl))[at]
    root_cam = np.asarray(pose.transl)[at] + scale[:, None] * np.asarray(model.rig.joints)[0]
    rotations = np.concatenate([np.asarray(pose.global_orient)[at, None], np.asarray(pose.body_pose)[at]], axis=1)
    if crop is None:
        return _InImage(rotations, root_cam, scale, root_cam[:, 2])
    root_crop_px = np.asarray(project(root_cam, model.camera))
    root_px = np.asarray(crop_to_image(root_crop_px[:, None], crop[at], model.camera.size_px))[:, 0]
    return _InImage(rotations, root_px, scale * _px_per_unit(crop[at], root_cam[:, 2], model), root_cam[:, 2])


def _px_per_unit(crop: np.ndarray, depth: np.ndarray, model: FitModel) -> np.ndarray:
    """Return the image pixels of one model unit at a depth in the crop camera."""
    return crop[:, 2] / model.camera.size_px * model.camera.focal_px / depth


def _with_poses(
    result: FittedWindow, crop: np.ndarray | None, at: np.ndarray, new: _InImage, model: FitModel
) -> FittedWindow:
    """Return a result with other poses in the frames `at`, in the crops of its window."""
    old, scale, root_cam = result.pose, new.size, new.root
    if crop is not None:
        scale = new.size / _px_per_unit(crop[at], new.depth, model)
        root_crop_px = image_to_crop(new.root[:, None], crop[at], model.camera.size_px)[:, 0]
        xy_cam = (root_crop_px - model.camera.centre_px) / model.camera.focal_px * new.depth[:, None]
        root_cam = np.concatenate([xy_cam, new.depth[:, None]], axis=1)

    def changed(values: Any, frames: np.ndarray) -> np.ndarray:
        values = np.array(values, np.float32)
        values[at] = frames
        return values

    pose = replace(
        old,
        global_orient=changed(old.global_orient, new.rotations[:, 0]),
        body_pose=changed(old.body_pose, new.rotations[:, 1:]),
        transl=changed(old.transl, root_cam - scale[:, None] * np.asarray(model.rig.joints)[0]),
        scale=changed(np.broadcast_to(old.scale, len(old.transl)), scale),
    )
    keypoints_cam, keypoints_px = (np.asarray(each) for each in _keypoints(model.rig, model.camera, pose))
    return result._replace(
        pose=pose,
        keypoints_cam=changed(result.keypoints_cam, keypoints_cam[at]),
        # with several views, the pixels come from the cameras
        keypoints_px=result.keypoints_px if crop is None else changed(result.keypoints_px, keypoints_px[at]),
    )


@jax.jit
def _nearest_axis_angle(old: Float[Array, "m J 3"], new: Float[Array, "m J 3"]) -> Float[Array, "m J 3"]:
    """Return `new` as axis-angles whose number of whole turns is that of `old`."""
    pairs = jnp.stack([old, new], axis=2)
    return jax.vmap(jax.vmap(unwrap_axis_angle))(pairs)[:, :, 1]


@eqx.filter_jit
def _keypoints(rig: Rig, camera: CropCamera, pose: Pose) -> tuple[Float[Array, "T K 3"], Float[Array, "T K 2"]]:
    points_cam = window_keypoints(rig, window_transforms(rig, pose), pose)
    return points_cam, project(points_cam, camera)


def summarise(solution: Solution, bird: Bird, seconds: dict[str, float]) -> dict[str, Any]:
    """Return the content of `summary.json`: counts; status, failures, flagged frames and loss of every track; timings;
    the identity of the video, and the lengths of the bodies relative to the model with their standard deviations, where
    they are known.

    Args:
        solution: the result.
        bird: the model of the fit.
        seconds: duration of each part of the command.
    """
    summary: dict[str, Any] = {} if solution.footage is None else {"video": solution.footage.entries()}
    if solution.bodies is not None:
        lengths = body_lengths(bird, solution.bodies).items()
        summary["body_lengths"] = {
            int(track): {name: [round(float(each.share[n]), 4), round(float(each.sd[n]), 4)] for name, each in lengths}
            for n, track in enumerate(solution.track_id)
            if np.isfinite(solution.bodies.frames[n])
        }
    return summary | {
        "tracks": len(solution.track_id),
        "frames": len(solution.frame_index),
        "fps": solution.fps,
        "poses": int(solution.valid.sum()),
        "status": dict(Counter(str(status) for status in solution.status)),
        "track_status": {int(t): str(s) for t, s in zip(solution.track_id, solution.status, strict=True)},
        "failures": solution.failures,
        "flags": flag_counts(solution.flags.doubts),
        "flagged": flagged_ranges(solution),
        "loss": {name: np.asarray(value).tolist() for name, value in solution.loss.items()},
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "model": {"name": bird.name, "hash": model_hash(bird)},
        "versions": {"python": platform.python_version()} | library_versions(LIBRARIES),
    }
