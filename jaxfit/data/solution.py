"""`Solution`: fitted poses, and the result folder."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64

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

FORMAT_VERSION = 9
"""Version of ``poses.npz``; increased when its arrays change. Version 8 lacks `Bodies` and `Triangulated`, version 7
also `contact`, version 6 also `World`, version 5 also `doubts`, version 4 also `ErrorBars`, version 3 also
`ambiguity_deg`, version 2 also `timestamp_s` and `fps`."""
_OLDEST_VERSION = 2
"""Older versions are not read."""

STATUSES = ("ok", "partly diverged", "diverged", "no usable frame")
"""The words of `Solution.status`."""

_WRITTEN_BY = "check the path; `jaxfit fit` and `jaxfit reconstruct` write results"
_TIMES = {"timestamp_s": ("T", np.float64), "fps": ("", np.float64)}


class _Arrays:
    """A record of arrays, which become read-only arrays of the types and shapes of its annotations."""

    def __post_init__(self):
        layout = layout_of(type(self))
        for name, array in validate_arrays(vars(self), layout).items():
            object.__setattr__(self, name, array if layout[name][0] else array.item())


@dataclass(frozen=True, eq=False)
class Keypoints(_Arrays):
    """The keypoints of the poses, in the order of `Solution.keypoint_names`."""

    cam: Float32[np.ndarray, "N T K 3"]
    """Model units, camera frame of the crop."""
    px: Float32[np.ndarray, "N T K 2"]
    """Image pixels."""


@dataclass(frozen=True, eq=False)
class Crops(_Arrays):
    """The square crops in which the poses lie, and their camera; the principal point is the centre of the crop."""

    square_px: Float32[np.ndarray, "N T 3"]
    """x0, y0 and side of the crop in image pixels."""
    image_size_px: Int64[np.ndarray, "N T 2"]
    """Width and height of the image of the bird; 0 where not valid."""
    focal_px: float
    """Focal length in pixels of the crop the fit works on."""
    crop_px: int
    """Side in pixels of the crop the fit works on."""


@dataclass(frozen=True, eq=False)
class Flags(_Arrays):
    """Reasons to doubt the poses."""

    ambiguity_deg: Float32[np.ndarray, "N T"]
    """Angle between the orientation and that of another pose that explains the keypoints almost as well (at most 20
    times less likely, turned by more than 45°); 0 where the fit found no such pose. Only fits with more than one
    hypothesis search for other poses."""
    doubts: Int8[np.ndarray, "N T"]
    """Sum of 2^i over the doubts i of `jaxfit.data.flags.DOUBTS` about the pose; 0: no doubt; −1: no pose, or not
    judged."""


@dataclass(frozen=True, eq=False)
class ErrorBars(_Arrays):
    """Error bars of the poses (`fitting/error_bars.py`); NaN where a window has none."""

    global_orient_sd: Float32[np.ndarray, "N T 3"]
    """Radians, about the axes of the root of the bird."""
    body_pose_sd: Float32[np.ndarray, "N T bones 3"]
    """Radians, about the axes of the joint."""
    transl_sd: Float32[np.ndarray, "N T 3"]
    """Model units."""
    scale_sd: Float32[np.ndarray, "N T"]
    """0 where every bird has the size of the model."""
    bone_length_sd: Float32[np.ndarray, "N T bones"]
    """0 where bone lengths are fixed."""
    betas_sd: Float32[np.ndarray, "N T S"]
    """0 where the shape is fixed."""
    keypoints_cam_cov: Float32[np.ndarray, "N T K 3 3"]
    """Squared model units, camera frame of the crop."""
    keypoints_centred_cov: Float32[np.ndarray, "N T K 3 3"]
    """The same, of the keypoints relative to their mean."""
    keypoints_px_cov: Float32[np.ndarray, "N T K 2 2"]
    """Squared image pixels."""
    misfit: Float32[np.ndarray, "N T"]
    """Factor on all covariances of the window, 1 or more, where the keypoints lie farther from the pose than the
    objective assumes. The other arrays contain it."""


@dataclass(frozen=True, eq=False)
class World(_Arrays):
    """The poses in the world of calibrated cameras or of a ledge."""

    R_world_root: Float32[np.ndarray, "N T 3 3"]
    """Rotation from the root of the bird to the world."""
    transl_world_m: Float64[np.ndarray, "N T 3"]
    """Root joint in the world, metres."""
    keypoints_world_m: Float64[np.ndarray, "N T K 3"]
    """Keypoints in the world, metres."""


@dataclass(frozen=True, eq=False)
class Triangulated(_Arrays):
    """The keypoints of the detections in the world, without the model, where two calibrated cameras agree; else NaN.

    A bird without a pose can have them.
    """

    keypoints_triangulated_m: Float64[np.ndarray, "N T K 3"]
    """Metres."""
    keypoints_triangulated_sd_m: Float64[np.ndarray, "N T K 3"]
    """Standard deviations along the axes of the world (`cameras.triangulation.triangulation_sd`)."""


@dataclass(frozen=True, eq=False)
class Bodies(_Arrays):
    """One body for each track (`fitting/bodies.py`); NaN for tracks without a fitted window."""

    bone_length: Float32[np.ndarray, "N bones"]
    """Relative to the rest skeleton."""
    bone_length_sd: Float32[np.ndarray, "N bones"]
    """0 where bone lengths are fixed."""
    betas: Float32[np.ndarray, "N S"]
    betas_sd: Float32[np.ndarray, "N S"]
    """0 where the shape is fixed."""
    frames: Float32[np.ndarray, "N"]
    """Number of independent frames that the data of the track are worth."""
    determined: Float32[np.ndarray, "N"]
    """How many of the numbers of the body the data determine; 0: the body is that of the model."""
    keypoint_scale: Float32[np.ndarray, "N"]
    """Scale of the keypoint errors, as a multiple of the scale in the config."""
    keypoint_offsets: Float32[np.ndarray, "N K 3"]
    """Detected keypoints minus keypoints of the model, in the rest pose, model units: sideways, to the bill, up."""
    outline_offset: Float32[np.ndarray, "N"]
    """How far the outlines of masks lie outside the mesh, model units."""


def layout_of(record: type) -> dict[str, tuple[str, Any]]:
    """Return field → (shape, dtype) of a record, from its annotations, as `validate_arrays` expects it."""
    scalars = {float: ("", np.float64), int: ("", np.int64)}
    layout: dict[str, tuple[str, Any]] = {}
    for name, hint in get_type_hints(record).items():
        if record is Pose:  # its arrays have any leading axes
            shape = " ".join(["N T", *get_args(hint)[1].dim_str.split()[1:]])
            layout[name] = (shape, np.float32)
        else:
            layout[name] = scalars[hint] if hint in scalars else (hint.dim_str, np.dtype(hint.dtypes[0]).type)
    return layout


_GROUPS: dict[str, Any] = {
    "poses": Pose,
    "keypoints": Keypoints,
    "crops": Crops,
    "flags": Flags,
    "error_bars": ErrorBars,
    "world": World,
    "triangulated": Triangulated,
    "bodies": Bodies,
}
_OPTIONAL = ("error_bars", "world", "triangulated", "bodies")
_OTHER_NAMES = {("keypoints", "cam"): "keypoints_cam", ("keypoints", "px"): "keypoints_px"} | {
    ("crops", "square_px"): "crop"
}
_OTHER_NAMES |= {("bodies", name): f"body_{name}" for name in layout_of(Bodies)}
PLACES = {
    _OTHER_NAMES.get((group, name), name): (group, name) for group in _GROUPS for name in layout_of(_GROUPS[group])
}
"""Name of an array in ``poses.npz`` → the group and the field of `Solution` that hold it."""


def _group_layout(group: str) -> dict[str, tuple[str, Any]]:
    """Return name in ``poses.npz`` → (shape, dtype) of the arrays of a group."""
    layout = layout_of(_GROUPS[group])
    return {name: layout[field] for name, (of_group, field) in PLACES.items() if of_group == group}


LAYOUT: dict[str, tuple[str, Any]] = {
    "track_id": ("N", np.int64),
    "frame_index": ("T", np.int64),
    "valid": ("N T", np.bool_),
    **_group_layout("poses"),
    **_group_layout("keypoints"),
    **_group_layout("crops"),
    **_group_layout("flags"),
    "keypoint_names": ("K", np.str_),
    "joint_names": ("J", np.str_),
    "status": ("N", np.str_),
}
"""The arrays of every ``poses.npz``."""
ERROR_BARS, WORLD, TRIANGULATED, BODIES = (_group_layout(name) for name in _OPTIONAL)
LEDGE = {"contact": ("N T", np.float32)}
OPTIONAL = ERROR_BARS | WORLD | TRIANGULATED | BODIES | LEDGE
"""The arrays that a ``poses.npz`` may have."""


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """Poses of N tracks over T frames; J joints, K keypoints, S shape coefficients.

    The arrays are read-only NumPy arrays. Values are arbitrary, and possibly NaN, where ``valid`` is False.
    `from_arrays` makes a solution from arrays by their names in ``poses.npz``.

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
    poses: Pose
    """The fitted poses; every field is float32 and has leading axes (N, T). Camera frame of the crop, model units."""
    keypoints: Keypoints
    """The keypoints of the poses."""
    crops: Crops
    """The crops in which the poses lie."""
    keypoint_names: tuple[str, ...]
    """K names."""
    joint_names: tuple[str, ...]
    """J names, the root first."""
    status: np.ndarray
    """(N,) str: summary of the track's windows. ``ok``: all fitted; ``partly diverged``: only the poses of the other
    windows are valid; ``diverged``: no window fitted; ``no usable frame``: no window."""
    loss: Mapping[str, np.ndarray]
    """Term → (N,) float64: its weighted share of the final objective, summed over the track's windows that did not
    diverge; NaN where there is none."""
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
    flags: Flags = None  # type: ignore[assignment]
    """Reasons to doubt the poses. None means that no pose was judged."""
    error_bars: ErrorBars | None = None
    """Error bars; None without."""
    world: World | None = None
    """Poses in the world; None for a fit in no world."""
    triangulated: Triangulated | None = None
    """Triangulated keypoints; None for a fit of one camera."""
    bodies: Bodies | None = None
    """The bodies of the birds; None for a fit without a stage that shares the body."""
    contact: np.ndarray | None = None
    """(N, T) float32: probability that the bird stands on the ledge z = 0. None: no ledge is known."""

    def __post_init__(self):
        if self.flags is None:
            object.__setattr__(self, "flags", _not_judged(np.shape(self.valid)))
        arrays = _typed(self.arrays())
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
        if not 0 < self.crops.focal_px < math.inf:
            raise ValueError(f"focal_px must be above 0 and finite, not {self.crops.focal_px}")
        if not 1 <= self.crops.crop_px <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"crop_px must be in 1…{MAX_IMAGE_SIDE_PX}, not {self.crops.crop_px}")
        times = np.full(len(arrays["frame_index"]), np.nan) if self.timestamp_s is None else self.timestamp_s
        layout = {"frame_index": LAYOUT["frame_index"], "timestamp_s": _TIMES["timestamp_s"]}
        arrays |= validate_arrays({"frame_index": arrays["frame_index"], "timestamp_s": times}, layout)
        check_times(arrays["timestamp_s"], self.fps)
        check_poses(arrays, arrays["valid"])
        unknown = np.flatnonzero(~np.isin(arrays["status"], STATUSES))
        if len(unknown):
            track, status = arrays["track_id"][unknown[0]], arrays["status"][unknown[0]]
            raise ValueError(f"status of track {track} is '{status}', expected one of: {', '.join(STATUSES)}")
        for name in _NAMES:
            if len(set(arrays[name])) < len(arrays[name]):
                raise ValueError(f"{name} must name each part once")
        for name, value in _grouped(arrays | {"loss": loss}).items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(cls, **values: Any) -> Solution:
        """Return a solution from arrays by their names in ``poses.npz`` (`PLACES`), and from other fields.

        Raises:
            ValueError: an array is missing, or has another type or shape.
        """
        values = {name: value for name, value in values.items() if value is not None}
        values = vars(_not_judged(np.shape(values["valid"]))) | values
        return cls(**_grouped(values | _typed(values)))

    def with_arrays(self, **values: Any) -> Solution:
        """Return a solution with other arrays, by their names in ``poses.npz`` (`PLACES`), and other fields."""
        fields_now = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _GROUPS}
        return Solution.from_arrays(**fields_now | self.arrays() | values)

    def arrays(self) -> dict[str, Any]:
        """Return the arrays by their names in ``poses.npz``; without the arrays of absent groups."""
        arrays = {name: getattr(self, name) for name in (*LAYOUT, *self.optional_layout) if name not in PLACES}
        groups = ((name, getattr(self, group), field) for name, (group, field) in PLACES.items())
        return arrays | {name: getattr(group, field) for name, group, field in groups if group is not None}

    @property
    def optional_layout(self) -> dict[str, tuple[str, Any]]:
        """The entries of `ERROR_BARS`, `WORLD`, `TRIANGULATED`, `BODIES` and `LEDGE` that the solution has."""
        optional = ((getattr(self, group), _group_layout(group)) for group in _OPTIONAL)
        optional = (*optional, (self.contact, LEDGE))
        return {name: entry for value, layout in optional if value is not None for name, entry in layout.items()}

    def cells(self, error_bars: bool | None = None) -> dict[str, np.ndarray]:
        """Return the arrays (N, T, …) by their names in ``poses.npz``, without those of a world.

        Args:
            error_bars: whether the error bars belong to them; where the solution has none, they are NaN. None: if the
                solution has error bars.
        """
        wanted = self.error_bars is not None if error_bars is None else error_bars
        arrays = self.arrays()
        sizes = {"N": self.valid.shape[0], "T": self.valid.shape[1], "K": len(self.keypoint_names), "2": 2, "3": 3}
        sizes |= {"bones": len(self.joint_names) - 1, "S": self.poses.betas.shape[2]}
        return {
            name: arrays[name] if name in arrays else np.full([sizes[s] for s in shape.split()], np.nan, dtype)
            for name, (shape, dtype) in (LAYOUT | (ERROR_BARS if wanted else {})).items()
            if shape.startswith("N T")
        }

    def __repr__(self) -> str:
        statuses = Counter(self.status.tolist())
        judged = self.flags.doubts[self.valid & (self.flags.doubts >= 0)]
        numbers, size = self.frame_index.tolist(), self.poses.scale[self.valid]
        times = self.timestamp_s[np.isfinite(self.timestamp_s)] if self.timestamp_s is not None else np.zeros(0)
        lines = {
            "tracks": f"{len(self.track_id)}: " + ", ".join(f"{count} {status}" for status, count in statuses.items()),
            "frames": f"{len(numbers)}" + (f": {numbers[0]} to {numbers[-1]}" if numbers else ""),
            "times": f"{times[0]:.2f} to {times[-1]:.2f} s" if len(times) else "unknown",
            "poses": f"{int(self.valid.sum())} of {self.valid.size}, {len(self.joint_names)} joints"
            + (f", size {size.min():.3g} to {size.max():.3g}" if len(size) else ""),
            "keypoints": f"{len(self.keypoint_names)}: {', '.join(self.keypoint_names[:4])}, …",
            "crops": f"{self.crops.crop_px} pixels, focal length {self.crops.focal_px:g} pixels",
            "flags": f"{int((judged > 0).sum())} of {len(judged)} judged poses with doubts",
            "error_bars": "None" if self.error_bars is None else "standard deviations and covariances",
            "world": "None" if self.world is None else "places in metres" + (", contact" * (self.contact is not None)),
            "loss": ", ".join(self.loss) or "none",
        }
        return "\n".join(["Solution", *(f"  {name:<11}{text}" for name, text in lines.items())])

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            places = {old: f"{group}.{field}" for old, (group, field) in PLACES.items()} | {"pose": "poses"}
            places |= {"has_error_bars": "error_bars is not None", "has_world": "world is not None"}
            if name in places:
                raise AttributeError(f"Solution has no attribute {name}: use solution.{places[name]}", name=name)
            raise AttributeError(f"Solution has no attribute {name}", name=name)


_NAMES = ("keypoint_names", "joint_names")


def _typed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays among some values in the types of their layout, names and single numbers as Python's types.

    Raises:
        ValueError: an array has another type or shape.
    """
    layout = LAYOUT | OPTIONAL
    arrays: dict[str, Any] = validate_arrays(values, {name: layout[name] for name in layout if name in values})
    arrays |= {name: tuple(arrays[name].tolist()) for name in _NAMES if name in arrays}
    numbers = {"focal_px": float, "crop_px": int}
    return arrays | {name: kind(values[name]) for name, kind in numbers.items() if name in values}


def _not_judged(shape: tuple[int, ...]) -> Flags:
    """Return the flags of poses that were not judged."""
    return Flags(ambiguity_deg=np.zeros(shape, np.float32), doubts=np.full(shape, -1, np.int8))


def _grouped(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of `Solution` from arrays by their names in ``poses.npz`` and from other fields.

    Raises:
        ValueError: some arrays of a group are missing.
    """
    result = {name: value for name, value in values.items() if name not in PLACES}
    for group, record in _GROUPS.items():
        names = {field: name for name, (of_group, field) in PLACES.items() if of_group == group}
        missing = [name for name in names.values() if name not in values]
        if group in _OPTIONAL and len(missing) == len(names):
            continue
        if missing:
            raise ValueError(f"{missing[0]} is missing: {group} needs all of {', '.join(names.values())}")
        result[group] = record(**{field: values[name] for field, name in names.items()})
    return result


def select_solution(solution: Solution, rows: np.ndarray, columns: np.ndarray) -> Solution:
    """Return M tracks and L frames of a solution, chosen by their positions.

    The loss of a track stays the loss over all its frames.
    """
    arrays: dict[str, Any] = solution.arrays() | {"timestamp_s": solution.timestamp_s}
    for name, (shape, _) in (LAYOUT | solution.optional_layout | _TIMES).items():
        if shape.startswith("N"):
            arrays[name] = arrays[name][rows]
        if "T" in shape.split():
            arrays[name] = arrays[name].take(columns, axis=shape.split().index("T"))
    kept = set(arrays["track_id"].tolist())
    loss = {term: values[rows] for term, values in solution.loss.items()}
    failures = {track: texts for track, texts in solution.failures.items() if track in kept}
    return solution.with_arrays(**arrays, loss=loss, failures=failures)


MAX_ANGLE_RAD, MAX_NUMBER = 1e4, 1e12
"""Largest angle, and largest other number of a pose: beyond them, 32 bits keep no angle and no position."""


def check_poses(arrays: Mapping[str, np.ndarray], fitted: np.ndarray) -> None:
    """Check the numbers of tracks and frames, and the poses of fitted frames.

    Args:
        arrays: some arrays of `LAYOUT`, among them `track_id` and `frame_index`, with shapes that agree.
        fitted: (N, T) bool: where the poses are checked.

    Raises:
        ValueError: a track or a frame is there twice, frames are not in order, or a fitted frame holds NaN, an
            infinite or impossible number, or a size that is not positive; the message names the array, the track and
            the frame.
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

    limits = {"global_orient": MAX_ANGLE_RAD, "body_pose": MAX_ANGLE_RAD, "R_world_root": 1.001}
    for name, (shape, dtype) in (LAYOUT | WORLD).items():
        if shape.startswith("N T") and np.dtype(dtype).kind == "f" and name in arrays:
            require(name, np.isfinite(arrays[name]), "holds NaN or infinite numbers")
            limit = limits.get(name, MAX_NUMBER)
            require(name, np.abs(arrays[name]) <= limit, f"holds numbers beyond {limit:g}")
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
    layout = LAYOUT | solution.optional_layout
    arrays: dict[str, Any] = {name: np.asarray(value, layout[name][1]) for name, value in solution.arrays().items()}
    terms = list(solution.loss)
    arrays["loss"] = np.stack([solution.loss[t] for t in terms], -1) if terms else np.zeros((len(solution.status), 0))
    arrays["loss_terms"] = np.array(terms, dtype=np.str_)
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
    shapes = {name: shape for name, (shape, _) in LAYOUT.items()} | {"loss": "N L", "loss_terms": "L"}
    optional = {name: shape for name, (shape, _) in (_TIMES | OPTIONAL).items()}
    optional |= {name: shapes.pop(name) for name in ("ambiguity_deg", "doubts")}
    arrays: dict[str, Any] = load_npz(path, shapes, FORMAT_VERSION, _OLDEST_VERSION, optional=optional)
    terms, loss = arrays.pop("loss_terms"), arrays.pop("loss")
    try:
        if terms.dtype.kind != "U" or len(np.unique(terms)) < len(terms):
            raise ValueError("loss_terms must be different names")
        fps = validate_arrays({"fps": arrays.pop("fps", np.nan)}, {"fps": _TIMES["fps"]})["fps"].item()
        losses = {str(term): loss[:, i] for i, term in enumerate(terms)}
        fps = None if math.isnan(fps) else fps
        solution = Solution.from_arrays(**arrays, loss=losses, fps=fps, footage=_footage(folder / SUMMARY))
    except ValueError as error:
        raise InputError(path, str(error), "run the fit again") from error
    bird = load_bird(folder / MODEL)
    if (bird.joint_names, bird.keypoint_names) != (solution.joint_names, solution.keypoint_names):
        raise InputError(folder / MODEL, f"is not the model of {POSES}", "run the fit again")
    if bird.num_shapes != solution.poses.betas.shape[2]:
        problem = f"has {bird.num_shapes} shape coefficients, but {POSES} has {solution.poses.betas.shape[2]}"
        raise InputError(folder / MODEL, problem, "run the fit again")
    return solution, bird


def _footage(summary: Path) -> FootageIdentity | None:
    """Return the identity of the video from `summary.json`; None if the file is absent or names no video."""
    content = read_json(summary) if summary.is_file() else None
    if content is None or not content.has("video"):
        return None
    return footage_of(content["video"])
