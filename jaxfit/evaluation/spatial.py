"""Metrics in space, and the alignment with true poses.

Parts of the 3D errors of posed birds, in NumPy. Leading axes (…) are birds, of any number; NaN where nothing is
measured. See also ``metrics.mpjpe`` and ``metrics.pa_mpjpe``.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.data.solution import Solution
from jaxfit.data.tracks import consecutive
from jaxfit.evaluation import metrics
from jaxfit.evaluation.metrics import distances
from jaxfit.evaluation.truth import match
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird, rest_bone_lengths, rest_length
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_joints
from jaxfit.model.rotation import axis_angle_to_matrix, geodesic_distance


def crop_rotation(centre_px: Any, principal_px: Any, focal_px: float) -> np.ndarray:
    """Return the rotation from the frame of a crop's camera to the frame of the real camera.

    A fit treats its crop as the image of a camera that looks at the centre of the crop. In the real camera, this
    centre lies on the ray d = ((centre − principal point) / focal, 1). So the optical axis e_z of the crop's camera
    is the direction d. R is the shortest rotation from e_z to d, which keeps the image upright:

    R = I + [v]× + [v]×² / (1 + c),  v = e_z × d/‖d‖,  c = e_z · d/‖d‖

    Without R, the orientation of a bird near the edge of a wide image is wrong by up to half the angle of view.

    Args:
        centre_px: (…, 2) centre of the crop, image pixels.
        principal_px: (…, 2) principal point of the camera, image pixels.
        focal_px: focal length of the camera, image pixels.

    Returns:
        (…, 3, 3): R with x_camera = R x_crop.

    Source: Mehta et al. 2017, *Monocular 3D Human Pose Estimation In The Wild Using Improved CNN Supervision*,
    perspective correction.
    """
    offset = (np.asarray(centre_px, np.float64) - np.asarray(principal_px, np.float64)) / focal_px
    ray = np.concatenate([offset, np.ones((*offset.shape[:-1], 1))], axis=-1)
    x, y, c = np.moveaxis(ray / np.linalg.norm(ray, axis=-1, keepdims=True), -1, 0)
    zero = np.zeros_like(c)
    V = np.stack([np.stack(row, -1) for row in ([zero, zero, x], [zero, zero, y], [-x, -y, zero])], -2)
    return np.eye(3) + V + V @ V / (1 + c)[..., None, None]


def best_scale(predicted: Any, truth: Any, counted: Any) -> np.ndarray:
    """Return the scale factor that brings the predicted points of a bird closest to the truth, over all frames.

    min over a ≥ 0 of Σ_tk ‖a p_tk − q_tk‖²:  a = max(0, Σ p·q / Σ p·p)

    Args:
        predicted: (…, T, K, 3) relative to the origin of each frame.
        truth: (…, T, K, 3) relative to the origin of each frame.
        counted: (…, T) bool: the frames that count.

    Returns:
        (…); NaN where no frame counts or all points lie at the origin.

    Source: Rhodin et al. 2018 (N-MPJPE), with one factor per track instead of one factor per frame.
    """
    used = np.asarray(counted, bool)[..., None, None]
    p, q = np.where(used, predicted, 0.0), np.where(used, truth, 0.0)
    squares = (p * p).sum((-3, -2, -1))
    return np.where(squares > 0, np.maximum((p * q).sum((-3, -2, -1)), 0) / np.where(squares > 0, squares, 1), np.nan)


def acceleration_errors(predicted: Any, truth: Any, counted: Any, frame_index: Any) -> np.ndarray:
    """Return the error of the points' acceleration, in their unit per squared frame of the file.

    ‖Δ²p_tk − Δ²q_tk‖ at t, the middle of three frames,  Δ²x_t = x_t−1 − 2 x_t + x_t+1

    In a file of every n-th frame of a video, a difference spans n frames of the video and is not divided by n.

    Args:
        predicted: (…, T, K, 3) in the frame and unit of the truth.
        truth: (…, T, K, 3).
        counted: (…, T) bool: the frames that count; a triple counts where all three frames count.
        frame_index: (T,) numbers of the frames in the video; a triple counts where the frames are consecutive: their
            numbers differ by the step of the file (`jaxfit.data.tracks.frame_step`).

    Returns:
        (…, T, K); NaN where no triple counts.

    Source: Kanazawa et al. 2019, *Learning 3D Human Dynamics from Video*; their acceleration error is the mean of
    this.
    """
    predicted, truth, counted = np.asarray(predicted, np.float64), np.asarray(truth, np.float64), np.asarray(counted)
    errors = np.full(predicted.shape[:-1], np.nan)
    steps = consecutive(frame_index)
    triple = counted[..., :-2] & counted[..., 1:-1] & counted[..., 2:] & steps[:-1] & steps[1:]
    difference = np.linalg.norm(np.diff(predicted - truth, 2, axis=-3), axis=-1)
    errors[..., 1:-1, :] = np.where(triple[..., None], difference, np.nan)
    return errors


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
    "bone_error",
    "bone_error_mean_bird",
)
_REMEDY = "give the truth that the simulation wrote with the scene"


class SpatialErrors:
    """3D errors of the birds of a result, matched with the true birds by track id and frame number.

    The crop of the true poses is the same in every frame, and the camera of this crop is the real camera: the centre
    of the crop is the principal point, and focal · size / crop_px is the focal length, both in image pixels. The
    crops of the result follow the birds; ``crop_rotation`` rotates their content into the frame of the real camera.

    Then two quantities are removed that a single camera cannot observe. The position of the bird: the points of each
    frame are taken relative to the root. The size of the bird, since a larger bird at a greater distance looks the
    same: the points of a track are multiplied by one factor (``best_scale``). Let p and q be the resulting points of
    the result and of the truth, in model units of the truth:

    - ``mpjpe``: mean over points and frames of ‖p − q‖;
    - ``pa_mpjpe``: the same after the best rotation, scale and translation of each frame;
    - ``mpjpe/length``, ``pa_mpjpe/length``: the same as a fraction of the body length of the true bird, which is the
      rest distance from bill_tip to tail_tip times the scale in this frame; NaN where the model lacks a keypoint;
    - ``orientation_deg``, ``orientation_median_deg``: mean and median over frames of the angle between the global
      orientations, in degrees; NaN where the models have different joints, since their rest poses may differ;
    - ``acceleration``: mean over points and triples of consecutive frames of ‖Δ²p − Δ²q‖, in model units per squared
      frame of the file (``acceleration_errors``);
    - ``size_error``, ``size_bias``: mean over frames of |r − 1| and of r − 1. r is the ratio of the predicted to the
      true apparent size: rest body length · scale · focal (image pixels) / depth of the root. The rest lengths cancel
      if both models are the same; they are 1 where a model lacks the keypoints;
    - ``bone_error``: mean over bones and frames of |a·b − l| / l. b and l are the lengths of a bone in the result and
      in the truth, and the factor a = Σ b·l / Σ b² removes the size; NaN where the models have different joints;
    - ``bone_error_mean_bird``: the same with the mean bone lengths of the model in place of b: the error of a result
      that knows only the mean bird.

    The points are the joints, matched by name, where both models have the same joints, and joint 0 is the root.
    Otherwise the points are the keypoints, and their mean is the root.

    Args:
        solution: the result.
        bird: the model of the result.
        truth: the true poses.
        truth_bird: the model of the true poses.
        source: the file or folder of the truth, for error messages.

    Raises:
        InputError: no common track and frame, different keypoints, or true poses without a single camera.
    """

    points: Literal["joints", "keypoints"]
    """The points that are compared."""
    measured: Bool[np.ndarray, "N T"]
    """Where both the result and the truth have a pose."""

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
        principal, focal = real_camera(truth, source)
        centre = solution.crops.square_px[..., :2] + solution.crops.square_px[..., 2:] / 2
        R = crop_rotation(centre, principal, focal)  # here and below: arbitrary or NaN where not measured

        same = sorted(solution.joint_names) == sorted(truth.joint_names)
        self.points = "joints" if same else "keypoints"
        if same:
            order = [solution.joint_names.index(name) for name in truth.joint_names]
            p, q = _joints(solution, bird)[:, :, order], _joints(truth, truth_bird)[n, t]
            root_p, root_q = p[:, :, :1], q[:, :, :1]
        else:
            order = [solution.keypoint_names.index(name) for name in truth.keypoint_names]
            p, q = solution.keypoints.cam[:, :, order].astype(np.float64), truth.keypoints.cam[n, t].astype(np.float64)
            root_p, root_q = p.mean(2, keepdims=True), q.mean(2, keepdims=True)
        p, self.truth = (p - root_p) @ np.swapaxes(R, -1, -2), q - root_q
        self.predicted = p * best_scale(p, self.truth, self.measured)[:, None, None, None]

        self.body_length = np.broadcast_to(rest_length(truth_bird) * truth.poses.scale[n, t], self.measured.shape)
        orient_p = jnp.asarray(R) @ axis_angle_to_matrix(jnp.asarray(solution.poses.global_orient))
        orient_q = axis_angle_to_matrix(jnp.asarray(truth.poses.global_orient[n, t]))
        angle = np.rad2deg(np.asarray(geodesic_distance(orient_p, orient_q), np.float64))
        self.angle_deg = angle if same else np.full(angle.shape, np.nan)
        self.bones = self.mean_bones = np.full((*self.measured.shape, 1), np.nan)
        if same:
            joints = [solution.joint_names.index(name) - 1 for name in truth.joint_names[1:]]
            true_length = rest_bone_lengths(truth_bird) * truth.poses.bone_length[n, t].astype(np.float64)
            self.bones, self.mean_bones = (
                _bone_errors((rest_bone_lengths(bird) * length)[..., joints], true_length)
                for length in (solution.poses.bone_length, np.asarray(bird.bone_mean))
            )
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = rest_length(bird) / rest_length(truth_bird)
            ratio = _apparent_size(solution, bird) / _apparent_size(truth, truth_bird)[n, t]
        self.size_ratio = ratio * (rest if np.isfinite(rest) else 1.0)

    def errors(self) -> dict[str, Float[np.ndarray, "N T _"]]:
        """Return the errors of every bird, frame and point; a metric is their mean. NaN where nothing is measured."""
        p, q, length = self.predicted, self.truth, self.body_length[..., None]
        counted = np.broadcast_to(self.measured[..., None], p.shape[:-1])
        direct, aligned = distances(p, q, counted), distances(metrics.procrustes_align(p, q, counted), q, counted)

        def of_frames(values: Float[np.ndarray, "N T"]) -> Float[np.ndarray, "N T 1"]:
            return of_bones(values[..., None])

        def of_bones(values: Float[np.ndarray, "N T B"]) -> Float[np.ndarray, "N T B"]:
            return np.where(self.measured[..., None], values, np.nan)

        return {
            "mpjpe": direct,
            "mpjpe/length": direct / length,
            "pa_mpjpe": aligned,
            "pa_mpjpe/length": aligned / length,
            "orientation_deg": of_frames(self.angle_deg),
            "acceleration": acceleration_errors(p, q, self.measured, self.frame_index),
            "size_error": of_frames(np.abs(self.size_ratio - 1)),
            "size_bias": of_frames(self.size_ratio - 1),
            "bone_error": of_bones(self.bones),
            "bone_error_mean_bird": of_bones(self.mean_bones),
        }


def _bone_errors(own: Float[np.ndarray, "*#N B"], true: Float[np.ndarray, "*N B"]) -> Float[np.ndarray, "*N B"]:
    """Return the error of each length as a share of the true length, after one factor for all bones; NaN for a bone
    without length."""
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = (own * true).sum(-1, keepdims=True) / (own**2).sum(-1, keepdims=True)
        return np.where(true > 0, np.abs(factor * own / true - 1), np.nan)


def real_camera(truth: Solution, source: object) -> tuple[np.ndarray, float]:
    """Return the principal point and the focal length of the real camera, image pixels."""
    crops = truth.crops.square_px[truth.valid].astype(np.float64)
    if not len(crops):
        raise InputError(source, "its true poses are all invalid", _REMEDY)
    if not np.isfinite(crops).all() or np.ptp(crops, axis=0).max() > 1e-3 or not crops[0, 2] > 0:
        problem = "its true poses lie in crops that follow the birds, not in one camera"
        raise InputError(source, problem, f"{_REMEDY}; the result of a fit is no truth")
    x0, y0, size = crops[0]
    return np.array([x0 + size / 2, y0 + size / 2]), truth.crops.focal_px * size / truth.crops.crop_px


def _apparent_size(solution: Solution, bird: Bird) -> np.ndarray:
    """Return the image pixels per model unit at the root, (N, T); the pose rotates about the root's rest position."""
    poses, crops = solution.poses, solution.crops
    depth = poses.transl[..., 2] + poses.scale * float(np.asarray(bird.joints)[0, 2])
    return np.asarray(poses.scale * (crops.focal_px * crops.square_px[..., 2] / crops.crop_px) / depth)


def _joints(solution: Solution, bird: Bird) -> np.ndarray:
    """Return the joints in the camera frame of the crop, (N, T, J, 3)."""
    return np.asarray(_pose_joints(fold_bird(bird), solution.poses), np.float64)


@jax.jit
def _pose_joints(rig: Rig, poses: Pose) -> Float[Array, "N T J 3"]:
    def one(pose: Pose):
        return posed_joints(rig, joint_transforms(rig, pose), pose)

    return jax.vmap(jax.vmap(one))(poses)
