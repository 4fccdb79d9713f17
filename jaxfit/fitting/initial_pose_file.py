"""Initial poses from a file: the output of a pose regressor, or the poses of an earlier fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT, check_poses
from jaxfit.errors import InputError
from jaxfit.fitting.windows import Windows
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.storage.arrays import validate_arrays
from jaxfit.storage.npz import load_npz, npz_names

__all__ = ["InitialPoses", "load_initial_poses"]

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
    rows = _positions(observations.track_id, content["track_id"])
    columns = _positions(observations.frame_index, content["frame_index"])
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


def _positions(numbers: Int[np.ndarray, "A"], sequence: Int[np.ndarray, "B"]) -> Int[np.ndarray, "A"]:
    """Return the position of each number in the sequence, or −1 if the sequence lacks the number."""
    position = {int(number): i for i, number in enumerate(sequence)}
    return np.array([position.get(int(number), -1) for number in numbers], int)
