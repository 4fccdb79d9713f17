"""Files of other programs: movement, NWB, SLEAP, DeepLabCut, COCO.

2D keypoints for correction by hand, as COCO, SLEAP and DeepLabCut; `jaxfit import` reads the corrected files. The
keypoints are the projected keypoints of the poses, each with confidence 1, because a person corrects all of them. A
frame without a pose has no bird.

netCDF files for the package movement (`ds_type` = poses). Source: the layout is that of the poses of movement 0.17,
whose dimensions have names in the singular. Versions up to 0.16 have the dimensions `keypoints` and `individuals`.

Positions in NWB are in image pixels, and in metres for results in a world. A frame without a pose is NaN. The file has
a skeleton, a series of positions and confidences for every keypoint, and a link to the footage.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import os
import uuid
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from jaxfit.data.flags import flag_ranges, flags
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.write_deeplabcut import write_deeplabcut_predictions
from jaxfit.data.formats.write_sleap import write_sleap_project
from jaxfit.data.observations import Observations
from jaxfit.data.projection import projected_observations
from jaxfit.data.tracks import frame_step
from jaxfit.export.result import CONFIDENCE, ON_LEDGE, SD, TRIANGULATED, Exported, describe_tracks, export_folder
from jaxfit.foundation.errors import InputError, one_line
from jaxfit.foundation.extras import __version__, require_package
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask
from jaxfit.foundation.reading import json_text
from jaxfit.model.anatomy import skeleton_pairs

if TYPE_CHECKING:
    import xarray


def write_coco_keypoints(exported: Exported, out: Path, progress: ProgressTask) -> list[Path]:
    """Write COCO, with the masks of the detections; `info` holds the status and the quality of the tracks."""
    exported.require_poses()
    s = exported.solution
    keypoints = _keypoints(exported)
    if exported.observations is not None:
        masks = {(n, t): rle for (n, t), rle in exported.observations.masks.items() if s.valid[n, t]}
        keypoints = replace(keypoints, file_name=exported.observations.file_name, masks=masks)
    status = {str(track): str(status) for track, status in zip(s.track_id.tolist(), s.status, strict=True)}
    quality = {str(track): row._asdict() for track, row in exported.quality.items()}
    info = {"description": f"projected keypoints of {one_line(exported.source.name)}, by jaxfit"}
    info |= {"track_status": json_text(status), "track_quality": json_text(quality)}
    with progress("Writing COCO", None):
        write_coco(keypoints, out, info)
    return [out]


def write_slp_keypoints(exported: Exported, out: Path, progress: ProgressTask) -> list[Path]:
    """Write a SLEAP project with predictions on the footage.

    Raises:
        InputError: h5py is not installed, the footage is unknown, or no pose is chosen.
    """
    require_package("h5py", "--to slp")
    exported.require_poses()
    with progress("Writing SLEAP", None):
        write_sleap_project(_keypoints(exported), str(exported.require_video()), out)
    return [out]


def write_dlc_keypoints(exported: Exported, out: Path, progress: ProgressTask) -> list[Path]:
    """Write predictions of DeepLabCut for several animals, as `.h5` or `.csv`.

    Raises:
        InputError: h5py is not installed, or no pose is chosen.
    """
    if out.suffix == ".h5":
        require_package("h5py", "--to dlc")
    exported.require_poses()
    with progress("Writing DeepLabCut", None):
        write_deeplabcut_predictions(_keypoints(exported), out)
    return [out]


def _keypoints(exported: Exported) -> Observations:
    observations = projected_observations(exported.solution)
    times = exported.times_s if np.isfinite(exported.times_s).all() else None
    return replace(observations, timestamp_s=times, fps=exported.fps)


_READERS = {
    "singular": "movement 0.17 or newer reads this file; for movement 0.16 or older, export with --dims plural",
    "plural": "movement 0.16 or older reads this file; for movement 0.17 or newer, export without --dims plural",
}
"""Names of the dimensions → the versions of movement that read them."""


def write_movement(
    exported: Exported,
    out: Path,
    progress: ProgressTask,
    space: Literal["2d", "3d", "world"] = "2d",
    dims: Literal["singular", "plural"] = "singular",
) -> tuple[list[Path], list[str]]:
    """Write a netCDF file with `position` (time, space, keypoint, individual) and `confidence`.

    A result with error bars also has `position_sd`, with the dimensions of `position`, except in the world. In the
    world, a result of several cameras also has `position_triangulated` and `position_triangulated_sd`. A result on a
    ledge also has `on_ledge` (time, individual).

    Frame numbers that the result lacks between its first and last frame are frames of NaN, so that the frames have
    equal distances in time. The individual of track 3 has the name `bird_3`.

    Args:
        exported: the result.
        out: the file to write.
        progress: shows progress.
        space: `2d` for image pixels, `3d` for the camera frame of the image, `world` for the world of the result.
        dims: `singular` for the dimensions `keypoint` and `individual`, `plural` for `keypoints` and `individuals`.

    Returns:
        The file, and a note about the versions of movement that read the file.

    Raises:
        InputError: xarray or h5netcdf is not installed, the frame rate is unknown, or the result is in no world.
    """
    dataset = movement_dataset(exported, space, dims)
    with progress("Writing netCDF", None):
        write_whole(out, netcdf(dataset))
    return [out], [_READERS[dims]]


def movement_dataset(
    exported: Exported, space: Literal["2d", "3d", "world"], dims: Literal["singular", "plural"] = "singular"
) -> xarray.Dataset:
    """Return the data set of `write_movement`, to which further variables can be added.

    Args:
        exported, space, dims: as for `write_movement`.

    Raises:
        InputError: as for `write_movement`.
    """
    for package in ("xarray", "h5netcdf"):
        require_package(package, "netCDF files")
    import xarray

    s, fps = exported.solution, exported.sampling_fps
    numbers = np.arange(s.frame_index[0], s.frame_index[-1] + 1, frame_step(s.frame_index))
    column = np.searchsorted(numbers, s.frame_index)
    points, sd, unit, facts = _positions(exported, space)

    def in_time(values: np.ndarray) -> np.ndarray:
        arranged = np.full((len(numbers), *values.shape[3:1:-1], values.shape[0]), np.nan, values.dtype)
        arranged[column] = values.transpose(1, 3, 2, 0)
        return arranged

    position = in_time(points)
    confidence = np.full((len(numbers), *position.shape[2:]), np.nan, np.float32)
    confidence[column] = exported.confidence.transpose(1, 2, 0)
    keypoint, individual = ("keypoint", "individual") if dims == "singular" else ("keypoints", "individuals")
    of_position = ("time", "space", keypoint, individual)
    arrays = {"position": (of_position, position, {"units": unit})}
    if sd is not None:
        arrays["position_sd"] = (of_position, in_time(sd.astype(np.float32)), {"units": unit, "description": SD})
    if space == "world" and s.triangulated is not None:
        for name, values in vars(s.triangulated).items():
            about = {"units": "metres", "description": TRIANGULATED}
            arrays[name.replace("keypoints", "position").removesuffix("_m")] = (of_position, in_time(values), about)
    return xarray.Dataset(
        {
            **arrays,
            "confidence": (("time", keypoint, individual), confidence, {"description": CONFIDENCE}),
            **_quality(exported, individual, column, len(numbers)),
        },
        coords={
            "time": np.interp(numbers, s.frame_index, exported.times_s),
            "space": list("xyz"[: position.shape[1]]),
            keypoint: list(s.keypoint_names),
            individual: [f"bird_{track}" for track in s.track_id.tolist()],
            "frame": ("time", numbers),
        },
        attrs={
            "source_software": "jaxfit",
            "ds_type": "poses",
            "fps": fps,
            "time_unit": "seconds",
            "source_file": str(exported.source),
            **facts,
        },
    )


def netcdf(dataset: xarray.Dataset) -> bytes:
    """Return a data set as a netCDF file, with compressed numbers."""
    content = io.BytesIO()
    numbers = [name for name, values in dataset.data_vars.items() if values.dtype.kind == "f" and values.ndim > 1]
    dataset.to_netcdf(content, engine="h5netcdf", encoding={name: {"zlib": True, "complevel": 4} for name in numbers})
    return content.getvalue()


def _positions(exported: Exported, space: str) -> tuple[np.ndarray, np.ndarray | None, str, dict[str, Any]]:
    """Return positions (N, T, K, 2 or 3) in a space, their standard deviations, their unit, and facts about them."""
    if space == "2d":
        facts = {"position_frame": "image, x right, y down"}
        return exported.keypoints_px, exported.keypoints_px_sd, "pixels", facts
    if space == "world":
        return exported.require_world(), None, "metres", {"position_frame": exported.world_frame}
    facts = {"position_frame": "camera frame of the image, z forward", "focal_length_px": exported.focal_px}
    unit = {"m": "metres", "unit": "model units"}[exported.unit]
    return exported.keypoints_3d, exported.keypoints_3d_sd, unit, facts


def _quality(exported: Exported, individual: str, column: np.ndarray, length: int) -> dict[str, tuple]:
    """Return flags and contacts of the poses, the status of the tracks, and the quality of their detections if known.

    Args:
        exported: the result.
        individual: name of the dimension of the tracks.
        column: position of each frame of the result in the dimension `time`.
        length: length of the dimension `time`.
    """
    s = exported.solution
    flag = np.full((length, len(s.track_id)), "", "<U12")
    flag[column] = flags(s.flags.doubts).T
    found: dict[str, tuple] = {
        "flag": (("time", individual), flag, {"description": "ok, unsure, contradicted; empty: no pose"}),
        "status": ((individual,), s.status.astype(str), {"description": "how the fit of the track ended"}),
    }
    contact = exported.contact
    if contact is not None:
        on_ledge = np.full(flag.shape, np.nan, np.float32)
        on_ledge[column] = contact.T
        found["on_ledge"] = (("time", individual), on_ledge, {"description": ON_LEDGE})
    if exported.quality:
        rows = [exported.quality.get(track) for track in s.track_id.tolist()]
        for name in ("coverage", "mean_confidence"):
            values = np.array([np.nan if row is None else getattr(row, name) for row in rows])
            found[f"track_{name}"] = ((individual,), values)
    return found


_ORIGIN = "(0, 0) is the upper left corner of the image, x right, y down, pixels"
_SPECIES = {"murre": "Uria aalge"}


def write_nwb(
    exported: Exported, out: Path, progress: ProgressTask, start: str | None = None, overwrite: bool = False
) -> tuple[list[Path], list[str]]:
    """Write one NWB file for every bird with a pose, into a folder.

    Args:
        exported: the result.
        out: the folder.
        progress: shows progress.
        start: time of the first frame of the footage (ISO 8601); None stores 1970-01-01, which the note says.
        overwrite: replace an earlier export in the folder.

    Raises:
        InputError: pynwb or ndx-pose is missing or too old, the frame rate or the footage is unknown, no pose is
            chosen, or the start is no time.
    """
    for package in ("pynwb", "ndx-pose"):
        require_package(package, "--to nwb")
    exported.require_poses()
    exported.require_fps()
    try:
        began = datetime.datetime.fromisoformat(start or "1970-01-01T00:00:00+00:00")
    except ValueError:
        remedy = "write for example 2024-06-01T12:00:00+02:00"
        raise InputError("--start", f"is '{start}', not a time", remedy) from None
    began = began if began.tzinfo else began.replace(tzinfo=datetime.UTC)
    video = exported.require_video()
    # from the folder of the files; the stored path if the footage was moved
    link = os.path.relpath(video.resolve(), out.resolve()) if video.exists() else str(video)
    footage_s = exported.footage_times_s()
    tracks = exported.solution.track_id.tolist()
    fitted = np.flatnonzero(exported.solution.valid.any(axis=1)).tolist()
    names = {tracks[n]: f"bird_{tracks[n]}.nwb" for n in fitted}
    with (
        export_folder(exported, out, overwrite, names, {"confidence": CONFIDENCE}) as folder,
        progress("Writing NWB", len(fitted)) as report_progress,
    ):
        for n in fitted:
            _write_bird(exported, n, began, link, footage_s, folder / names[tracks[n]])
            report_progress(1, names[tracks[n]])
    notes = []
    if start is None:
        notes.append("the start of the recording is unknown and stored as 1970-01-01: give --start to store the time")
    return [out / name for name in names.values()], notes


def _write_bird(
    exported: Exported,
    n: int,
    began: datetime.datetime,
    video: str,
    footage_s: Float[np.ndarray, "F"],
    path: Path,
) -> None:
    pynwb, ndx_pose = _library("pynwb"), _library("ndx_pose")
    s, track = exported.solution, int(exported.solution.track_id[n])
    facts = describe_tracks(exported)[str(track)]
    # the same export has the same identifier
    digest = hashlib.sha256(f"{video} {track}".encode() + s.keypoints.px[n].tobytes() + s.valid[n].tobytes()).digest()
    file = pynwb.NWBFile(
        session_description=f"3D pose of bird {track}, fitted by jaxfit to {one_line(exported.require_video().name)}",
        identifier=str(uuid.UUID(bytes=digest[:16])),
        session_start_time=began,
        notes=json_text(facts),
    )
    species = _SPECIES.get(exported.bird.name)
    about: dict[str, Any] = {"species": species} if species else {}
    subject = pynwb.file.Subject(
        subject_id=f"bird_{track}", sex="U", age="P0D/", description="track of a video", **about
    )
    file.subject = subject
    footage = pynwb.image.ImageSeries(
        name="footage",
        description="the video that the poses were fitted to",
        external_file=[video],
        format="external",
        starting_frame=[0],
        **_even_or_not(footage_s),
        num_samples=len(footage_s),
        unit="n.a.",
        dimension=s.crops.image_size_px[s.valid].max(0).tolist(),
    )
    file.add_acquisition(footage)
    edges = np.array(skeleton_pairs(s.keypoint_names), np.uint8).reshape(-1, 2)
    skeleton = ndx_pose.Skeleton(name="bird", nodes=list(s.keypoint_names), edges=edges, subject=subject)
    series = _series(exported, n)
    pose = ndx_pose.PoseEstimation(
        name="PoseEstimation",
        pose_estimation_series=series,
        description=f"projected keypoints of the fitted mesh; the fit ended with the status: {facts['status']}",
        original_videos=[video],
        scorer="jaxfit",
        source_software="jaxfit",
        source_software_version=__version__,
        skeleton=skeleton,
        source_video=footage,
    )
    behaviour = file.create_processing_module("behavior", "poses of the bird")
    behaviour.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    behaviour.add(pose)
    for further in _further_series(exported, n, series[0]):
        behaviour.add(further)
    intervals = _flag_intervals(exported, n)
    if intervals is not None:
        file.add_time_intervals(intervals)
    with pynwb.NWBHDF5IO(path, "w") as io:
        io.write(file)


def _flag_intervals(exported: Exported, n: int) -> Any:
    """Return the flags of the poses, one interval for a range of frames with the same flag; None without flags."""
    s, frame_s = exported.solution, 1 / exported.sampling_fps
    doubts = s.flags.doubts[n]
    found, times = flags(doubts[None])[0], exported.times_s
    rows = [(a, b, reasons) for a, b, reasons in flag_ranges(doubts) if found[a]]
    if not rows:
        return None
    description = "flags of poses: whether the detections agree with the pose"
    intervals = _library("pynwb").epoch.TimeIntervals(name="pose_flags", description=description)
    intervals.add_column("flag", "ok, unsure (not determined by the detections) or contradicted by the detections")
    intervals.add_column("doubts", "the reasons; empty for ok")
    for a, b, reasons in rows:
        start, stop = float(times[a]), float(times[b - 1] + frame_s)
        intervals.add_row(start_time=start, stop_time=stop, flag=str(found[a]), doubts="; ".join(reasons))
    return intervals


def _timing(exported: Exported, first: Any = None) -> dict[str, Any]:
    """Return the times of a series of poses; uneven times are a link to the series `first` if it is given."""
    timing = _even_or_not(exported.times_s)
    return timing if first is None or "rate" in timing else {"timestamps": first}


def _even_or_not(times_s: Float[np.ndarray, "T"]) -> dict[str, Any]:
    """Return start and rate where times are even, else the times."""
    steps = np.diff(times_s)
    if len(steps) and np.abs(steps - steps[0]).max() < 1e-6:
        return {"starting_time": float(times_s[0]), "rate": float(1 / steps.mean())}
    return {"timestamps": times_s}


def _series(exported: Exported, n: int) -> list[Any]:
    """Return one series for every keypoint. The series share their times."""
    ndx_pose = _library("ndx_pose")
    points, confidence = exported.keypoints_px[n], exported.confidence[n]
    series: list[Any] = []
    for k, name in enumerate(_series_names(exported.solution.keypoint_names)):
        one = ndx_pose.PoseEstimationSeries(
            name=name,
            description=f"keypoint {one_line(exported.solution.keypoint_names[k])}",
            data=points[:, k],
            unit="pixels",
            reference_frame=_ORIGIN,
            **_timing(exported, series[0] if series else None),
            confidence=confidence[:, k],
            confidence_definition=CONFIDENCE,
        )
        series.append(one)
    return series


def _further_series(exported: Exported, n: int, first: Any) -> list[Any]:
    """Return the series that ndx-pose has no field for: standard deviations, the bird in the world and on the ledge.

    A `SpatialSeries` has one point at a time, so the keypoints in the world are a `TimeSeries`, whose description
    states the frame.
    """
    rows: list[tuple[str, np.ndarray, str, str]] = []
    if (sd := exported.keypoints_px_sd) is not None:
        rows.append(("keypoints_sd", sd[n], "pixels", f"axes: time, node of the skeleton, (x, y). {SD}"))
    if exported.solution.world is not None:
        description = f"axes: time, node of the skeleton, (x, y, z). Reference frame: {exported.world_frame}"
        rows.append(("keypoints_world", exported.require_world()[n], "metres", description))
    if (triangulated := exported.solution.triangulated) is not None:
        axes = f"axes: time, node of the skeleton, (x, y, z). {exported.world_frame}. {TRIANGULATED}"
        points, sd = triangulated.keypoints_triangulated_m, triangulated.keypoints_triangulated_sd_m
        rows.append(("keypoints_triangulated", points[n], "metres", axes))
        rows.append(("keypoints_triangulated_sd", sd[n], "metres", axes))
    if (contact := exported.contact) is not None:
        rows.append(("on_ledge", contact[n], "n.a.", ON_LEDGE))
    timing, new = _timing(exported, first), _library("pynwb").TimeSeries
    return [new(name=name, data=data, unit=unit, description=text, **timing) for name, data, unit, text in rows]


def _series_names(names: tuple[str, ...]) -> list[str]:
    """Return names without the characters / and :, which NWB does not accept, each name once."""
    changed: list[str] = []
    for name in names:
        plain = name.replace("/", "_").replace(":", "_")
        while plain in changed:
            plain += "_"
        changed.append(plain)
    return changed


def _library(name: str) -> Any:
    """Return a library that makes its classes when it is imported, so that type checkers do not know them."""
    return import_module(name)
