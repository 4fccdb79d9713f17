"""Initial poses from a file: from a pose regressor, or from an earlier result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT
from jaxfit.errors import InputError
from jaxfit.fitting.windows import Windows
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.storage.arrays import validate_arrays
from jaxfit.storage.npz import load_npz

__all__ = ["InitialPoses", "load_initial_poses"]

_FIELDS = ("global_orient", "body_pose", "transl", "scale", "bone_length", "betas", "crop")
_LAYOUT = {name: LAYOUT[name] for name in ("track_id", "frame_index", *_FIELDS)}


@dataclass(frozen=True)
class InitialPoses:
    """Initial poses of the birds of one observations file, in the crop's camera frame; NaN where there is none."""

    source: str
    """Name of the file, for error messages."""
    global_orient: Float[np.ndarray, "N T 3"]
    body_pose: Float[np.ndarray, "N T bones 3"]
    transl: Float[np.ndarray, "N T 3"]
    scale: Float[np.ndarray, "N T"]
    bone_length: Float[np.ndarray, "N T bones"]
    betas: Float[np.ndarray, "N T S"]
    crop: Float[np.ndarray, "N T 3"] | None = None
    """The crops of the poses, (x0, y0, size) in image pixels; None where the file does not contain them."""

    @property
    def has_shape(self) -> bool:
        """Whether any shape coefficient is not zero."""
        return bool(np.any(np.nan_to_num(self.betas)))

    def check_crops(self, windows: Windows) -> None:
        """Check that every window has an initial pose, in the crop of the window.

        Raises:
            InputError: a window without any initial pose, or poses in other crops.
        """
        for n, track, frame, present, crop in zip(
            windows.track, windows.track_id, windows.frame, windows.present, windows.crop, strict=True
        ):
            at = frame[present]
            have = np.isfinite(self.global_orient[n, at]).all(-1)
            if not have.any():
                raise InputError(self.source, f"has no pose for track {track}", "add one")
            if self.crop is not None:
                apart = np.abs(self.crop[n, at] - crop[present])[have].max()
                if apart > 1:
                    raise InputError(
                        self.source,
                        f"`crop` of track {track} differs by {apart:.0f} pixels from the crop of this config",
                        "use the window and crop settings that made the file",
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
        """The initial pose of one window. A frame without a pose takes that of its nearest neighbour."""
        known = present & np.isfinite(self.global_orient[n, frame]).all(-1)
        have = np.flatnonzero(known)
        at = frame[have[np.abs(np.arange(len(frame))[:, None] - have).argmin(1)]]
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

    Two layouts are known: the arrays of a result's `poses.npz` (matched by `track_id` and `frame_index`), and
    a regressor's rows `init_pose` (N, J, 3), `init_bone_length` (N, J−1), `init_translation` (N, 3), one
    for each annotation in the order of tracks, then frames.

    Raises:
        InputError: a broken file, another layout, rows that do not match the observations or the bird.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            names = set(file.files)
    except (OSError, ValueError, EOFError, AttributeError):
        names = {"init_pose"}  # load_npz tells what is wrong
    except Exception:  # zipfile's own errors
        names = {"init_pose"}
    poses = _from_result(path, observations) if "global_orient" in names else _from_rows(path, observations)
    joints = poses.body_pose.shape[2] + 1
    if joints != bird.num_joints:
        raise InputError(path, f"has poses of {joints} joints", f"this bird has {bird.num_joints}")
    if poses.betas.shape[2] not in (0, bird.num_shapes):
        raise InputError(path, f"has {poses.betas.shape[2]} shape coefficients", f"this bird has {bird.num_shapes}")
    if poses.betas.shape[2] == 0:
        empty = np.zeros((*poses.betas.shape[:2], bird.num_shapes), np.float32)
        poses = replace(poses, betas=empty)
    return poses


def _from_result(path: str | Path, observations: Observations) -> InitialPoses:
    content = load_npz(path, {name: len(shape.split()) for name, (shape, _) in _LAYOUT.items()})
    try:
        content = validate_arrays(content, _LAYOUT)
    except ValueError as error:
        raise InputError(path, str(error), "give the poses.npz of a fit") from None
    fitted = np.isfinite(content["global_orient"]).all(-1)
    for name in _FIELDS:
        if not np.isfinite(content[name][fitted]).all():
            raise InputError(path, f"`{name}` holds NaN or infinite numbers", "give the poses.npz of a fit")
    rows = _positions(observations.track_id, content["track_id"])
    columns = _positions(observations.frame_index, content["frame_index"])
    missing = (rows < 0)[:, None] | (columns < 0)[None]
    if missing.all():
        raise InputError(path, "has no pose for any of these birds", "give the start of the same video")
    picked = {}
    for name in _FIELDS:
        picked[name] = content[name][rows][:, columns]
        picked[name][missing] = np.nan
    return InitialPoses(str(path), **picked)


def _from_rows(path: str | Path, observations: Observations) -> InitialPoses:
    content = load_npz(path, {"init_pose": 3, "init_bone_length": 2, "init_translation": 2})
    pose, bone, transl = content["init_pose"], content["init_bone_length"], content["init_translation"]
    rows = int(observations.present.sum())
    if not len(pose) == len(bone) == len(transl) == rows:
        raise InputError(
            path,
            f"has {len(pose)}, {len(bone)}, {len(transl)} rows",
            f"the observations have {rows} annotations",
        )
    if pose.shape[2] != 3 or transl.shape[1] != 3 or bone.shape[1] != pose.shape[1] - 1:
        raise InputError(path, f"`init_pose` is {pose.shape}, `init_bone_length` {bone.shape}", "(N, J, 3), (N, J−1)")
    if not all(np.isfinite(a).all() for a in (pose, bone, transl)):
        raise InputError(path, "holds NaN or infinite numbers", "remove those rows")

    def spread(values):
        full = np.full((*observations.present.shape, *values.shape[1:]), np.nan, np.float32)
        full[observations.present] = values
        return full

    return InitialPoses(
        str(path),
        global_orient=spread(pose[:, 0]),
        body_pose=spread(pose[:, 1:]),
        transl=spread(transl),
        scale=spread(np.ones(rows)),
        bone_length=spread(bone),
        betas=spread(np.zeros((rows, 0))),
    )


def _positions(wanted: Int[np.ndarray, "A"], having: Int[np.ndarray, "B"]) -> Int[np.ndarray, "A"]:
    """Position of each wanted number in `having`; −1 where it is not."""
    where = {int(number): i for i, number in enumerate(having)}
    return np.array([where.get(int(number), -1) for number in wanted], int)
