"""A result against true poses: both brought into one camera frame, up to what one camera cannot know."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.evaluation import metrics
from jaxfit.evaluation.keypoint_errors import distances
from jaxfit.evaluation.matching import match
from jaxfit.evaluation.metrics_3d import acceleration_errors, best_scale, crop_rotation
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird, joint_transforms, posed_joints
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import axis_angle_to_matrix, geodesic_distance

__all__ = ["COLUMNS_3D", "SpatialErrors"]

COLUMNS_3D = (
    "mpjpe",
    "mpjpe/length",
    "pa_mpjpe",
    "pa_mpjpe/length",
    "orientation_deg",
    "orientation_median_deg",
    "acceleration",
    "size_error",
    "size_bias",
)
_REMEDY = "give the truth that the simulation wrote with the scene"


class SpatialErrors:
    """How far a result's birds are from the true ones in space, matched by track and frame number.

    The true poses are a result too, whose crop is the square in which the crop's camera is the real one: its
    centre is the principal point and focal · size / crop_px the focal length, in image pixels, the same in every
    frame. The result's own crops follow the birds; ``crop_rotation`` turns what they hold into the true
    camera's frame.

    Then two things are taken out that no single camera sees: where the bird is (each frame's points are taken
    relative to its root) and how large it is, since a larger bird farther away looks the same (``best_scale``,
    one factor a track). With p and q what remains of the result and of the truth, in the truth's model units:

    - ``mpjpe``: mean over points and frames of ‖p − q‖;
    - ``pa_mpjpe``: the same after the rotation, scale and translation of each frame that fit best;
    - ``mpjpe/length``, ``pa_mpjpe/length``: the same as shares of the true bird's body length: rest distance
      from bill_tip to tail_tip times its scale in that frame; NaN where the model has no such keypoints;
    - ``orientation_deg``, ``orientation_median_deg``: mean and median over frames of the angle between the global
      orientations, in degrees; NaN where the models have other joints, whose rest poses need not agree;
    - ``acceleration``: mean over points and triples of successive frames of ‖Δ²p − Δ²q‖, in units per frame²;
    - ``size_error``, ``size_bias``: mean over frames of |r − 1| and of r − 1, where r is the predicted over the true
      apparent size: rest body length · scale · focal (image pixels) / depth of the root (rest lengths drop out
      for one model, and are 1 where a model lacks the keypoints).

    The points are the joints, by name, where both models have the same, with joint 0 as the root; otherwise the
    keypoints, with their mean as the root.

    Args:
        solution: the result.
        bird: its model.
        truth: the true poses.
        truth_bird: their model.
        source: what the truth was read from, for messages.

    Raises:
        InputError: no track or frame in common, other keypoints, or a truth whose crop is not one camera.
    """

    points: Literal["joints", "keypoints"]
    """What is compared."""
    measured: Bool[np.ndarray, "N T"]
    """Where both have a pose."""

    def __init__(
        self, solution: Solution, bird: Bird, truth: Solution, truth_bird: Bird, source: object = "truth"
    ) -> None:
        n, t, shared = match(solution, truth.track_id, truth.frame_index)
        if not shared.any():
            raise InputError(source, "its true poses share no track and frame with the result", _REMEDY)
        if sorted(truth.keypoint_names) != sorted(solution.keypoint_names):
            raise InputError(source, "its true poses have other keypoints than the result", _REMEDY)
        self.measured = shared & solution.valid & truth.valid[n, t]
        self.frame_index = solution.frame_index
        principal, focal = _real_camera(truth, source)
        centre = solution.crop[..., :2] + solution.crop[..., 2:] / 2
        R = crop_rotation(centre, principal, focal)  # here and below: NaN, or nothing, where not measured

        same = sorted(solution.joint_names) == sorted(truth.joint_names)
        self.points = "joints" if same else "keypoints"
        if same:
            order = [solution.joint_names.index(name) for name in truth.joint_names]
            p, q = _joints(solution, bird)[:, :, order], _joints(truth, truth_bird)[n, t]
            root_p, root_q = p[:, :, :1], q[:, :, :1]
        else:
            order = [solution.keypoint_names.index(name) for name in truth.keypoint_names]
            p, q = solution.keypoints_cam[:, :, order].astype(np.float64), truth.keypoints_cam[n, t].astype(np.float64)
            root_p, root_q = p.mean(2, keepdims=True), q.mean(2, keepdims=True)
        p, self.truth = (p - root_p) @ np.swapaxes(R, -1, -2), q - root_q
        self.predicted = p * best_scale(p, self.truth, self.measured)[:, None, None, None]

        self.body_length = np.broadcast_to(_rest_length(truth_bird) * truth.scale[n, t], self.measured.shape)
        orient_p = jnp.asarray(R) @ axis_angle_to_matrix(jnp.asarray(solution.global_orient))
        orient_q = axis_angle_to_matrix(jnp.asarray(truth.global_orient[n, t]))
        angle = np.rad2deg(np.asarray(geodesic_distance(orient_p, orient_q), np.float64))
        self.angle_deg = angle if same else np.full(angle.shape, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = _rest_length(bird) / _rest_length(truth_bird)
            ratio = _apparent_size(solution, bird) / _apparent_size(truth, truth_bird)[n, t]
        self.size_ratio = ratio * (rest if np.isfinite(rest) else 1.0)

    def errors(self) -> dict[str, Float[np.ndarray, "N T _"]]:
        """What every bird, frame and point adds to the means; NaN where nothing is measured."""
        p, q, length = self.predicted, self.truth, self.body_length[..., None]
        seen = np.broadcast_to(self.measured[..., None], p.shape[:-1])
        direct, aligned = distances(p, q, seen), distances(metrics.procrustes_align(p, q, seen), q, seen)

        def of_frames(values: Float[np.ndarray, "N T"]) -> Float[np.ndarray, "N T 1"]:
            return np.where(self.measured, values, np.nan)[..., None]

        return {
            "mpjpe": direct,
            "mpjpe/length": direct / length,
            "pa_mpjpe": aligned,
            "pa_mpjpe/length": aligned / length,
            "orientation_deg": of_frames(self.angle_deg),
            "acceleration": acceleration_errors(p, q, self.measured, self.frame_index),
            "size_error": of_frames(np.abs(self.size_ratio - 1)),
            "size_bias": of_frames(self.size_ratio - 1),
        }


def _real_camera(truth: Solution, source: object) -> tuple[np.ndarray, float]:
    """Principal point and focal length of the camera that filmed, image pixels."""
    crops = truth.crop[truth.valid].astype(np.float64)
    if not len(crops):
        raise InputError(source, "its true poses are all empty", _REMEDY)
    if not np.isfinite(crops).all() or np.ptp(crops, axis=0).max() > 1e-3 or not crops[0, 2] > 0:
        problem = "its true poses lie in crops that follow the birds, not in one camera"
        raise InputError(source, problem, f"{_REMEDY}; another fit's result is none")
    x0, y0, size = crops[0]
    return np.array([x0 + size / 2, y0 + size / 2]), truth.focal_px * size / truth.crop_px


def _rest_length(bird: Bird) -> float:
    """From bill tip to tail tip at rest, model units."""
    names = bird.keypoint_names
    if not {"bill_tip", "tail_tip"} <= set(names):
        return float("nan")
    rest = np.asarray(bird.keypoints, np.float64)
    return float(np.linalg.norm(rest[names.index("bill_tip")] - rest[names.index("tail_tip")]))


def _apparent_size(solution: Solution, bird: Bird) -> np.ndarray:
    """Image pixels per model unit at the root, (N, T); the root turns about its own rest position."""
    depth = solution.transl[..., 2] + solution.scale * float(np.asarray(bird.joints)[0, 2])
    return solution.scale * (solution.focal_px * solution.crop[..., 2] / solution.crop_px) / depth


def _joints(solution: Solution, bird: Bird) -> np.ndarray:
    """Joints in the camera frame of the crop, (N, T, J, 3)."""
    return np.asarray(_pose_joints(fold_bird(bird), solution.pose), np.float64)


@jax.jit
def _pose_joints(rig: Rig, poses: Pose) -> Float[Array, "N T J 3"]:
    def one(pose: Pose):
        return posed_joints(rig, joint_transforms(rig, pose), pose)

    return jax.vmap(jax.vmap(one))(poses)
