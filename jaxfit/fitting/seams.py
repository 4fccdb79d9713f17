"""Seams: windows of one track share frames, and the poses of these frames pass from one window to the next.

The windows are fitted independently. In the shared frames, the weight w of the later window rises linearly from 0 to 1.
Rotations are blended on SO(3): R = Ra exp(w log(Raᵀ Rb)). The position of the root joint in the image and the logarithm
of the apparent size are blended linearly, because the crops of the two windows differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.fitting.collect import FittedWindow
from jaxfit.fitting.stages import FitModel
from jaxfit.fitting.windows import Windows
from jaxfit.model.camera import crop_to_image, image_to_crop, project
from jaxfit.model.kinematics import window_keypoints, window_transforms
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import axis_angle_to_matrix, matrix_to_axis_angle, unwrap_axis_angle

__all__ = ["blend_seams", "shared_frames"]

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
    shape coefficients are those of the later window.

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
        _in_image(result.pose, windows.crop[i], at, model)
        for result, i, at in ((before, w - 1, at_before), (own, w, at_own))
    )
    weight = (np.arange(len(at_own)) + 1) / (len(at_own) + 1)
    R_before, R_own = (axis_angle_to_matrix(jnp.asarray(each.rotations)) for each in (earlier, later))
    turn = matrix_to_axis_angle(jnp.swapaxes(R_before, -1, -2) @ R_own)
    if np.linalg.norm(turn[:, 0], axis=-1).max() > LARGEST_ANGLE:
        weight = np.round(weight)
    R = R_before @ axis_angle_to_matrix(turn * jnp.asarray(weight, jnp.float32)[:, None, None])
    rotations = np.asarray(_nearest_axis_angle(jnp.asarray(later.rotations), matrix_to_axis_angle(R)))
    root_px = earlier.root_px + weight[:, None] * (later.root_px - earlier.root_px)
    size = earlier.size * (later.size / earlier.size) ** weight
    return _with_poses(own, windows.crop[w], at_own, _InImage(rotations, root_px, size, later.depth), model)


class _InImage(NamedTuple):
    """Poses of m frames, without the crop of their window."""

    rotations: Float[np.ndarray, "m J 3"]
    """Axis-angle of the root and of the other joints."""
    root_px: Float[np.ndarray, "m 2"]
    """Root joint, image pixels."""
    size: Float[np.ndarray, "m"]
    """Image pixels per model unit at the root."""
    depth: Float[np.ndarray, "m"]
    """Depth of the root in the crop camera, model units."""


def _in_image(pose: Pose, crop: np.ndarray, at: np.ndarray, model: FitModel) -> _InImage:
    scale = np.broadcast_to(pose.scale, len(pose.transl))[at]
    root_cam = np.asarray(pose.transl)[at] + scale[:, None] * np.asarray(model.rig.joints)[0]
    root_crop_px = np.asarray(project(root_cam, model.camera))
    root_px = np.asarray(crop_to_image(root_crop_px[:, None], crop[at], model.camera.size_px))[:, 0]
    rotations = np.concatenate([np.asarray(pose.global_orient)[at, None], np.asarray(pose.body_pose)[at]], axis=1)
    return _InImage(rotations, root_px, scale * _px_per_unit(crop[at], root_cam[:, 2], model), root_cam[:, 2])


def _px_per_unit(crop: np.ndarray, depth: np.ndarray, model: FitModel) -> np.ndarray:
    """Return the image pixels of one model unit at a depth in the crop camera."""
    return crop[:, 2] / model.camera.size_px * model.camera.focal_px / depth


def _with_poses(result: FittedWindow, crop: np.ndarray, at: np.ndarray, new: _InImage, model: FitModel) -> FittedWindow:
    """Return a result with other poses in the frames `at`, in the crops of its window."""
    old = result.pose
    scale = new.size / _px_per_unit(crop[at], new.depth, model)
    root_crop_px = image_to_crop(new.root_px[:, None], crop[at], model.camera.size_px)[:, 0]
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
    keypoints_cam, keypoints_px = (np.asarray(each) for each in _keypoints(model, pose))
    return result._replace(
        pose=pose,
        keypoints_cam=changed(result.keypoints_cam, keypoints_cam[at]),
        keypoints_px=changed(result.keypoints_px, keypoints_px[at]),
    )


@jax.jit
def _nearest_axis_angle(old: Float[Array, "m J 3"], new: Float[Array, "m J 3"]) -> Float[Array, "m J 3"]:
    """Return `new` as axis-angles whose number of whole turns is that of `old`."""
    pairs = jnp.stack([old, new], axis=2)
    return jax.vmap(jax.vmap(unwrap_axis_angle))(pairs)[:, :, 1]


@eqx.filter_jit
def _keypoints(model: FitModel, pose: Pose) -> tuple[Float[Array, "T K 3"], Float[Array, "T K 2"]]:
    points_cam = window_keypoints(model.rig, window_transforms(model.rig, pose), pose)
    return points_cam, project(points_cam, model.camera)
