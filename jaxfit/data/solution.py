"""`Solution`: fitted poses, and the result folder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cameras.camera import MAX_IMAGE_SIDE_PX
from jaxfit.data.footage import FootageIdentity, footage_of
from jaxfit.data.formats.fields import read_json
from jaxfit.data.observations import check_times
from jaxfit.data.result_folder import CONFIG, LEARNT, MODEL, POSES, SUMMARY
from jaxfit.foundation.array_files import load_npz, validate_arrays
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder, write_whole
from jaxfit.foundation.reading import check_folder, check_readable, json_text
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_bird, save_bird
from jaxfit.model.kinematics import Pose

FORMAT_VERSION = 8
"""Version of ``poses.npz``; increased when its arrays change. Version 7 lacks `LEDGE`, version 6 also `WORLD`,
version 5 also `doubts`, version 4 also `ERROR_BARS`, version 3 also `ambiguity_deg`, version 2 also `timestamp_s` and
`fps`."""
_OLDEST_VERSION = 2
"""Older versions are not read."""

STATUSES = ("ok", "partly diverged", "diverged", "no usable frame")
"""The words of `Solution.status`."""

_WRITTEN_BY = "check the path; `jaxfit fit` and `jaxfit reconstruct` write results"

_CAMERA = {"focal_px": ("", np.float64), "crop_px": ("", np.int64)}
_TIMES = {"timestamp_s": ("T", np.float64), "fps": ("", np.float64)}

LAYOUT = {
    "track_id": ("N", np.int64),
    "frame_index": ("T", np.int64),
    "valid": ("N T", np.bool_),
    "global_orient": ("N T 3", np.float32),
    "body_pose": ("N T J-1 3", np.float32),
    "transl": ("N T 3", np.float32),
    "scale": ("N T", np.float32),
    "bone_length": ("N T J-1", np.float32),
    "betas": ("N T S", np.float32),
    "keypoints_cam": ("N T K 3", np.float32),
    "keypoints_px": ("N T K 2", np.float32),
    "crop": ("N T 3", np.float32),
    "image_size_px": ("N T 2", np.int64),
    "keypoint_names": ("K", np.str_),
    "joint_names": ("J", np.str_),
    "status": ("N", np.str_),
    "ambiguity_deg": ("N T", np.float32),
    "doubts": ("N T", np.int8),
}
ERROR_BARS = {
    "global_orient_sd": ("N T 3", np.float32),
    "body_pose_sd": ("N T J-1 3", np.float32),
    "transl_sd": ("N T 3", np.float32),
    "scale_sd": ("N T", np.float32),
    "bone_length_sd": ("N T J-1", np.float32),
    "betas_sd": ("N T S", np.float32),
    "keypoints_cam_cov": ("N T K 3 3", np.float32),
    "keypoints_centred_cov": ("N T K 3 3", np.float32),
    "keypoints_px_cov": ("N T K 2 2", np.float32),
    "misfit": ("N T", np.float32),
}
"""The arrays of error bars. A solution has all of them or none."""
WORLD = {
    "R_world_root": ("N T 3 3", np.float32),
    "transl_world_m": ("N T 3", np.float64),
    "keypoints_world_m": ("N T K 3", np.float64),
}
"""The arrays of fits in a world. A solution has all of them or none."""
LEDGE = {"contact": ("N T", np.float32)}
"""The array of fits in a world whose plane z = 0 is the ledge."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses of N tracks over T frames; J joints, K keypoints, S shape coefficients.

    The arrays are read-only NumPy arrays. Values are arbitrary, and possibly NaN, where ``valid`` is False.

    Raises:
        ValueError: the shapes do not agree, or a valid frame holds values that no fit gives; the message names the
            array, and the first such track and frame.
    """

    track_id: np.ndarray
    """(N,) int64."""
    frame_index: np.ndarray
    """(T,) int64: numbers of the frames in the video."""
    valid: np.ndarray
    """(N, T) bool: the bird was fitted in this frame."""
    global_orient: np.ndarray
    """(N, T, 3) float32: axis-angle in radians, camera frame."""
    body_pose: np.ndarray
    """(N, T, J−1, 3) float32: axis-angle in radians, relative to the parent joint."""
    transl: np.ndarray
    """(N, T, 3) float32: model units, camera frame of the crop."""
    scale: np.ndarray
    """(N, T) float32: size relative to the model."""
    bone_length: np.ndarray
    """(N, T, J−1) float32: relative to the rest skeleton."""
    betas: np.ndarray
    """(N, T, S) float32: shape coefficients."""
    keypoints_cam: np.ndarray
    """(N, T, K, 3) float32: model units, camera frame of the crop."""
    keypoints_px: np.ndarray
    """(N, T, K, 2) float32: image pixels."""
    crop: np.ndarray
    """(N, T, 3) float32: x0, y0, size of the square crop in image pixels."""
    image_size_px: np.ndarray
    """(N, T, 2) int64: width, height of the image of the bird; 0 where not valid."""
    focal_px: float
    """Focal length in pixels of the crop the fit works on."""
    keypoint_names: tuple[str, ...]
    """K names."""
    joint_names: tuple[str, ...]
    """J names, the root first."""
    crop_px: int
    """Side in pixels of the crop the fit works on; the principal point is the centre of the crop."""
    loss: Mapping[str, np.ndarray]
    """Term → (N,) float64: its weighted share of the final objective, summed over the track's windows that did not
    diverge; NaN where there is none."""
    status: np.ndarray
    """(N,) str: summary of the track's windows. ``ok``: all fitted; ``partly diverged``: only the poses of the other
    windows are valid; ``diverged``: no window fitted; ``no usable frame``: no window."""
    failures: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    """Track → its skipped frames, and for each of its windows that diverged: frames, term and step. ``summary.json``
    holds them."""
    timestamp_s: np.ndarray | None = None
    """(T,) float64: presentation times of the frames in seconds, as ``jaxfit.video.reader.Frame.time_s``; NaN where the
    time is unknown. None means that no time is known."""
    fps: float | None = None
    """Mean frame rate of the whole video in frames per second, as its container states; None if unknown."""
    footage: FootageIdentity | None = None
    """Identity of the whole video; None if unknown. ``summary.json`` holds it."""

    ambiguity_deg: np.ndarray | None = None
    """(N, T) float32: angle between the orientation and that of another pose that explains the keypoints almost as well
    (at most 20 times less likely, turned by more than 45°); 0 where the fit found no such pose. Only fits with more
    than one hypothesis search for other poses. None means 0 everywhere."""

    doubts: np.ndarray | None = None
    """(N, T) int8: sum of 2^i over the doubts i of `jaxfit.data.flags.DOUBTS` about the pose; 0: no doubt; −1: no pose,
    or not judged. None means −1 everywhere."""

    # error bars (`fitting/error_bars.py`): None without, NaN where a window has none; docs/reference/result_folder.md
    global_orient_sd: np.ndarray | None = None
    """(N, T, 3) float32: radians, about the axes of the root of the bird."""
    body_pose_sd: np.ndarray | None = None
    """(N, T, J−1, 3) float32: radians, about the axes of the joint."""
    transl_sd: np.ndarray | None = None
    """(N, T, 3) float32: model units."""
    scale_sd: np.ndarray | None = None
    """(N, T) float32: 0 where every bird has the size of the model."""
    bone_length_sd: np.ndarray | None = None
    """(N, T, J−1) float32: 0 where bone lengths are fixed."""
    betas_sd: np.ndarray | None = None
    """(N, T, S) float32: 0 where the shape is fixed."""
    keypoints_cam_cov: np.ndarray | None = None
    """(N, T, K, 3, 3) float32: squared model units, camera frame of the crop."""
    keypoints_centred_cov: np.ndarray | None = None
    """(N, T, K, 3, 3) float32: the same, of the keypoints relative to their mean."""
    keypoints_px_cov: np.ndarray | None = None
    """(N, T, K, 2, 2) float32: squared image pixels."""
    misfit: np.ndarray | None = None
    """(N, T) float32: factor on all covariances of the window, 1 or more, where the keypoints lie farther from the pose
    than the objective assumes. The other arrays contain it."""

    # fits with calibrated cameras or on a ledge (`fitting/views.py`, `fitting/ledge.py`): None without
    R_world_root: np.ndarray | None = None
    """(N, T, 3, 3) float32: rotation from the root of the bird to the world."""
    transl_world_m: np.ndarray | None = None
    """(N, T, 3) float64: root joint in the world, metres."""
    keypoints_world_m: np.ndarray | None = None
    """(N, T, K, 3) float64: keypoints in the world, metres."""
    contact: np.ndarray | None = None
    """(N, T) float32: probability that the bird stands on the ledge z = 0. None: no ledge is known."""

    def __post_init__(self):
        ambiguity_deg = np.zeros(np.shape(self.valid), np.float32) if self.ambiguity_deg is None else self.ambiguity_deg
        doubts = np.full(np.shape(self.valid), -1, np.int8) if self.doubts is None else self.doubts
        layout = LAYOUT | self.optional_layout
        arrays = validate_arrays(vars(self) | {"ambiguity_deg": ambiguity_deg, "doubts": doubts}, layout)
        # a frame without a pose has no flag, whatever the array holds there
        arrays["doubts"] = np.where(arrays["valid"], arrays["doubts"], np.int8(-1))
        arrays["doubts"].flags.writeable = False
        if len(self.joint_names) != arrays["body_pose"].shape[2] + 1:
            bones = arrays["body_pose"].shape[2]
            raise ValueError(f"joint_names must be {bones + 1} for body_pose of {bones}, not {len(self.joint_names)}")
        loss = {}
        for term, value in self.loss.items():
            layout = {"status": LAYOUT["status"], f"loss[{term}]": ("N", np.float64)}
            loss[str(term)] = validate_arrays({"status": self.status, f"loss[{term}]": value}, layout)[f"loss[{term}]"]
        camera = validate_arrays({"focal_px": self.focal_px, "crop_px": self.crop_px}, _CAMERA)
        focal_px, crop_px = float(camera["focal_px"]), int(camera["crop_px"])
        if not 0 < focal_px < math.inf:
            raise ValueError(f"focal_px must be above 0 and finite, not {focal_px}")
        if not 1 <= crop_px <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"crop_px must be in 1…{MAX_IMAGE_SIDE_PX}, not {crop_px}")
        times = np.full(len(arrays["frame_index"]), np.nan) if self.timestamp_s is None else self.timestamp_s
        layout = {"frame_index": LAYOUT["frame_index"], "timestamp_s": _TIMES["timestamp_s"]}
        arrays |= validate_arrays({"frame_index": arrays["frame_index"], "timestamp_s": times}, layout)
        check_times(arrays["timestamp_s"], self.fps)
        check_poses(arrays, arrays["valid"])
        unknown = np.flatnonzero(~np.isin(arrays["status"], STATUSES))
        if len(unknown):
            track, status = arrays["track_id"][unknown[0]], arrays["status"][unknown[0]]
            raise ValueError(f"status of track {track} is '{status}', expected one of: {', '.join(STATUSES)}")
        for name in ("keypoint_names", "joint_names"):
            if len(np.unique(arrays[name])) < len(arrays[name]):
                raise ValueError(f"{name} must name each part once")
        for name in ("keypoint_names", "joint_names"):
            object.__setattr__(self, name, tuple(str(text) for text in arrays.pop(name)))
        for name, value in (arrays | {"loss": loss, "focal_px": focal_px, "crop_px": crop_px}).items():
            object.__setattr__(self, name, value)

    @property
    def has_error_bars(self) -> bool:
        """Whether the solution has the arrays `ERROR_BARS`.

        Raises:
            ValueError: the solution has some of the arrays only.
        """
        return self._has("error bars", ERROR_BARS)

    @property
    def has_world(self) -> bool:
        """Whether the solution has the arrays `WORLD`.

        Raises:
            ValueError: the solution has some of the arrays only.
        """
        return self._has("poses in the world", WORLD)

    def _has(self, what: str, layout: Mapping[str, Any]) -> bool:
        absent = [name for name in layout if getattr(self, name) is None]
        if absent and len(absent) < len(layout):
            raise ValueError(f"{absent[0]} is missing: {what} need all of {', '.join(layout)}")
        return not absent

    @property
    def optional_layout(self) -> dict[str, tuple[str, Any]]:
        """The entries of `ERROR_BARS`, `WORLD` and `LEDGE` that the solution has."""
        found = (ERROR_BARS if self.has_error_bars else {}) | (WORLD if self.has_world else {})
        return found | ({} if self.contact is None else LEDGE)

    def cells(self, error_bars: bool | None = None) -> dict[str, np.ndarray]:
        """Return the arrays (N, T, …) by name.

        Args:
            error_bars: whether the error bars belong to them; where the solution has none, they are NaN. None: if the
                solution has error bars.
        """
        wanted = self.has_error_bars if error_bars is None else error_bars
        layout = LAYOUT | (ERROR_BARS if wanted else {})
        found = {}
        sizes = {"N": self.valid.shape[0], "T": self.valid.shape[1], "K": len(self.keypoint_names)}
        sizes |= {"J-1": len(self.joint_names) - 1, "S": self.betas.shape[2], "2": 2, "3": 3}
        for name, (shape, dtype) in layout.items():
            if shape.startswith("N T"):
                values = getattr(self, name)
                found[name] = np.full([sizes[s] for s in shape.split()], np.nan, dtype) if values is None else values
        return found

    @property
    def pose(self) -> Pose:
        """The poses as a `Pose` of the model, every field (N, T, …)."""
        return Pose(**{each.name: getattr(self, each.name) for each in fields(Pose)})


def select_solution(solution: Solution, rows: np.ndarray, columns: np.ndarray) -> Solution:
    """Return M tracks and L frames of a solution, chosen by their positions.

    The loss of a track stays the loss over all its frames.
    """
    arrays = {}
    for name, (shape, _) in (LAYOUT | solution.optional_layout).items():
        if shape.split()[0] not in ("N", "T"):
            continue
        array = getattr(solution, name)
        if shape.startswith("N"):
            array = array[rows]
        if "T" in shape.split():
            array = array.take(columns, axis=shape.split().index("T"))
        arrays[name] = array
    kept = set(arrays["track_id"].tolist())
    return replace(
        solution,
        **arrays,
        loss={term: values[rows] for term, values in solution.loss.items()},
        failures={track: texts for track, texts in solution.failures.items() if track in kept},
        timestamp_s=None if solution.timestamp_s is None else solution.timestamp_s[columns],
    )


def check_poses(arrays: Mapping[str, np.ndarray], fitted: np.ndarray) -> None:
    """Check the numbers of tracks and frames, and the poses of fitted frames.

    Args:
        arrays: some arrays of `LAYOUT`, among them `track_id` and `frame_index`, with shapes that agree.
        fitted: (N, T) bool: where the poses are checked.

    Raises:
        ValueError: a track or a frame is there twice, frames are not in order, or a fitted frame holds NaN, an
            infinite number, or a size that is not positive; the message names the array, the track and the frame.
    """
    tracks, frames = arrays["track_id"], arrays["frame_index"]
    unique, count = np.unique(tracks, return_counts=True)
    if len(unique) < len(tracks):
        raise ValueError(f"track_id holds track {unique[count > 1][0]} twice")
    if len(frames) and frames[0] < 0:
        raise ValueError(f"frame_index must be 0 or more, not {frames[0]}")
    unordered = np.flatnonzero(frames[1:] <= frames[:-1])
    if len(unordered):
        pair = frames[unordered[0] : unordered[0] + 2]
        raise ValueError(f"frame_index must increase, but {pair[1]} follows {pair[0]}")

    def require(name: str, holds: np.ndarray, problem: str) -> None:
        bad = np.argwhere(fitted & ~holds.all(axis=tuple(range(2, holds.ndim))))
        if len(bad):
            n, t = bad[0]
            raise ValueError(f"{name} {problem} for track {tracks[n]}, frame {frames[t]}")

    for name, (shape, dtype) in LAYOUT.items():
        if shape.startswith("N T") and dtype is np.float32 and name in arrays:
            require(name, np.isfinite(arrays[name]), "holds NaN or infinite numbers")
    if "scale" in arrays:
        require("scale", arrays["scale"] > 0, "is not above 0")
    if "crop" in arrays:
        require("crop", arrays["crop"][..., 2] > 0, "has a size that is not above 0")
    if "image_size_px" in arrays:
        size = arrays["image_size_px"]
        require("image_size_px", (size > 0) & (size <= MAX_IMAGE_SIDE_PX), f"is not in 1…{MAX_IMAGE_SIDE_PX}")


def save_solution(
    solution: Solution,
    bird: Bird,
    config_yaml: str,
    summary: Mapping[str, Any],
    folder: str | Path,
    overwrite: bool = False,
    learnt_yaml: str | None = None,
) -> None:
    """Write a result folder, completely or not at all: ``poses.npz``, ``config.yaml``, ``summary.json``, ``model.npz``.

    Args:
        solution: the result.
        bird: the model of the fit, stored with the result, since poses have no meaning without their model.
        config_yaml: the config of the fit.
        summary: metrics, timings, versions; see `jaxfit.foundation.reading.json_values`.
        folder: the folder to write.
        overwrite: replace an older result folder, as soon as the new folder is complete.
        learnt_yaml: the config with learnt weights, for ``learnt.yaml``; None without learnt weights.

    Raises:
        InputError: the folder holds results already or something else, or cannot be written.
        TypeError: ``summary`` holds a value that JSON cannot represent.
    """
    with new_folder(folder, overwrite, marker=POSES) as part:
        write_solution(solution, bird, config_yaml, summary, part, learnt_yaml)


def write_solution(
    solution: Solution,
    bird: Bird,
    config_yaml: str,
    summary: Mapping[str, Any],
    folder: Path,
    learnt_yaml: str | None = None,
) -> None:
    """Write the files of `save_solution` into an existing folder, such as a temporary folder of `new_folder`."""
    summary_json = json_text(summary)
    names = [*LAYOUT, *solution.optional_layout]
    arrays: dict[str, Any] = {name: np.asarray(getattr(solution, name)) for name in names}
    terms = list(solution.loss)
    arrays["loss"] = np.stack([solution.loss[t] for t in terms], -1) if terms else np.zeros((len(solution.status), 0))
    arrays["loss_terms"] = np.array(terms, dtype=np.str_)
    arrays["focal_px"] = np.asarray(solution.focal_px, np.float64)
    arrays["crop_px"] = np.asarray(solution.crop_px, np.int64)
    arrays["timestamp_s"] = solution.timestamp_s
    arrays["fps"] = np.asarray(np.nan if solution.fps is None else solution.fps, np.float64)
    arrays["format_version"] = np.asarray(FORMAT_VERSION, np.int64)
    write_whole(folder / POSES, lambda file: np.savez_compressed(file, **arrays))
    write_whole(folder / CONFIG, config_yaml.encode())
    if learnt_yaml is not None:
        write_whole(folder / LEARNT, learnt_yaml.encode())
    write_whole(folder / SUMMARY, summary_json.encode())
    save_bird(bird, folder / MODEL)


def load_solution(folder: str | Path) -> tuple[Solution, Bird]:
    """Read the poses of a result folder, and their model.

    Args:
        folder: a folder that ``save_solution`` wrote.

    Raises:
        InputError: the folder does not exist; a file is missing, damaged or of another version; or the shapes of the
            arrays do not agree.
    """
    folder = check_folder(folder, "a folder of results", _WRITTEN_BY)
    path = check_readable(folder / POSES, "an .npz file", _WRITTEN_BY)
    shapes = {name: shape for name, (shape, _) in (LAYOUT | _CAMERA).items()}
    shapes |= {"loss": "N L", "loss_terms": "L"}
    optional = {name: shape for name, (shape, _) in (_TIMES | ERROR_BARS | WORLD | LEDGE).items()}
    optional |= {name: shapes.pop(name) for name in ("ambiguity_deg", "doubts")}
    arrays: dict[str, Any] = load_npz(path, shapes, FORMAT_VERSION, _OLDEST_VERSION, optional=optional)
    arrays |= {name: arrays[name].item() for name in _CAMERA}
    arrays |= {name: tuple(arrays[name].tolist()) for name in ("keypoint_names", "joint_names")}
    terms, loss = arrays.pop("loss_terms"), arrays.pop("loss")
    try:
        if terms.dtype.kind != "U" or len(np.unique(terms)) < len(terms):
            raise ValueError("loss_terms must be different names")
        fps = validate_arrays({"fps": arrays.pop("fps", np.nan)}, {"fps": _TIMES["fps"]})["fps"].item()
        losses = {str(term): loss[:, i] for i, term in enumerate(terms)}
        fps = None if math.isnan(fps) else fps
        solution = Solution(**arrays, loss=losses, fps=fps, footage=_footage(folder / SUMMARY))
    except ValueError as error:
        raise InputError(path, str(error), "run the fit again") from error
    bird = load_bird(folder / MODEL)
    if (bird.joint_names, bird.keypoint_names) != (solution.joint_names, solution.keypoint_names):
        raise InputError(folder / MODEL, f"is not the model of {POSES}", "run the fit again")
    if bird.num_shapes != solution.betas.shape[2]:
        problem = f"has {bird.num_shapes} shape coefficients, but {POSES} has {solution.betas.shape[2]}"
        raise InputError(folder / MODEL, problem, "run the fit again")
    return solution, bird


def _footage(summary: Path) -> FootageIdentity | None:
    """Return the identity of the video from `summary.json`; None if the file is absent or names no video."""
    content = read_json(summary) if summary.is_file() else None
    if content is None or not content.has("video"):
        return None
    return footage_of(content["video"])
