"""Starting points from a file: a pose regressor's, or an earlier result's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT
from jaxfit.errors import InputError
from jaxfit.fitting.window import Windows
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.storage.arrays import validate_arrays
from jaxfit.storage.npz import load_npz

__all__ = ["Start", "load_start"]

_FIELDS = ("global_orient", "body_pose", "transl", "scale", "bone_length", "betas", "crop")
_LAYOUT = {name: LAYOUT[name] for name in ("track_id", "frame_index", *_FIELDS)}


@dataclass(frozen=True)
class Start:
    """Starting poses of the birds of one observations file, crop camera frame; NaN where there is none."""

    source: str
    global_orient: Float[np.ndarray, "N T 3"]
    body_pose: Float[np.ndarray, "N T bones 3"]
    transl: Float[np.ndarray, "N T 3"]
    scale: Float[np.ndarray, "N T"]
    bone_length: Float[np.ndarray, "N T bones"]
    betas: Float[np.ndarray, "N T S"]
    crop: Float[np.ndarray, "N T 3"] | None = None
    """Crops that the poses belong to, where the file tells."""

    @property
    def has_shape(self) -> bool:
        """Whether any shape coefficient is not zero."""
        return bool(np.any(np.nan_to_num(self.betas)))

    def check_crops(self, observations: Observations, windows: Windows) -> None:
        """Check that every window has a start, in the crop that the window uses.

        Raises:
            InputError: a window without any starting pose, or poses of other crops.
        """
        for w in range(len(windows)):
            n, at = windows.track[w], windows.frame[w][windows.present[w]]
            have = np.isfinite(self.global_orient[n, at]).all(-1)
            if not have.any():
                raise InputError(self.source, f"has no pose for track {observations.track_id[n]}", "add one")
            if self.crop is not None:
                apart = np.abs(self.crop[n, at] - windows.crop[w][windows.present[w]])[have].max()
                if apart > 1:
                    raise InputError(
                        self.source,
                        f"`crop` of track {observations.track_id[n]} is {apart:.0f} pixels off this config's",
                        "use the window and crop settings that made the file",
                    )

    def window_pose(
        self,
        bird: Bird,
        n: int,
        frame: Int[np.ndarray, "T"],
        present: Bool[np.ndarray, "T"],
        common_size: bool,
    ) -> Pose:
        """The start of one window; a frame without one takes its nearest neighbour's."""
        at = np.maximum(frame, 0)
        have = np.flatnonzero(present & np.isfinite(self.global_orient[n, at]).all(-1))
        at = at[have[np.abs(np.arange(len(frame))[:, None] - have).argmin(1)]]
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


def load_start(path: str | Path, observations: Observations, bird: Bird) -> Start:
    """Read starting poses for the birds of `observations`.

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
    start = _from_result(path, observations) if "global_orient" in names else _from_rows(path, observations)
    joints = start.body_pose.shape[2] + 1
    if joints != bird.num_joints:
        raise InputError(path, f"has poses of {joints} joints", f"this bird has {bird.num_joints}")
    if start.betas.shape[2] not in (0, bird.num_shapes):
        raise InputError(path, f"has {start.betas.shape[2]} shape coefficients", f"this bird has {bird.num_shapes}")
    if start.betas.shape[2] == 0:
        empty = np.zeros((*start.betas.shape[:2], bird.num_shapes), np.float32)
        start = replace(start, betas=empty)
    return start


def _from_result(path: str | Path, observations: Observations) -> Start:
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
    return Start(str(path), **picked)


def _from_rows(path: str | Path, observations: Observations) -> Start:
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

    return Start(
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
