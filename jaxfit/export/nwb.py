"""NWB files with the extension ndx-pose: one file for each bird, because an NWB file has one subject.

Positions are in image pixels. A frame without a pose is NaN. The file has a skeleton, a series of positions and
confidences for every keypoint, and a link to the footage.
"""

from __future__ import annotations

import datetime
import hashlib
import os
import uuid
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit import __version__
from jaxfit.errors import InputError, one_line
from jaxfit.export.folder import describe_tracks, export_folder
from jaxfit.export.result import CONFIDENCE, Exported
from jaxfit.extras import require_package
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.progress import ProgressTask
from jaxfit.storage.json_values import json_text

__all__ = ["write_nwb"]

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
    exported.require_video()
    began = _start(start)
    tracks = exported.solution.track_id.tolist()
    fitted = np.flatnonzero(exported.solution.valid.any(axis=1)).tolist()
    names = {tracks[n]: f"bird_{tracks[n]}.nwb" for n in fitted}
    with (
        export_folder(exported, out, overwrite, names, {"confidence": CONFIDENCE}) as folder,
        progress("Writing NWB", len(fitted)) as report_progress,
    ):
        for n in fitted:
            _write_bird(exported, n, began, _link(exported.require_video(), out), folder / names[tracks[n]])
            report_progress(1, names[tracks[n]])
    notes = []
    if start is None:
        notes.append("the start of the recording is unknown and stored as 1970-01-01: give --start to store the time")
    return [out / name for name in names.values()], notes


def _start(text: str | None) -> datetime.datetime:
    try:
        time = datetime.datetime.fromisoformat(text or "1970-01-01T00:00:00+00:00")
    except ValueError:
        problem = f"is '{text}', not a time"
        raise InputError("--start", problem, "write for example 2024-06-01T12:00:00+02:00") from None
    return time if time.tzinfo else time.replace(tzinfo=datetime.UTC)


def _link(video: Path, folder: Path) -> str:
    """Return the path of the footage from the folder of the NWB files; the stored path if the footage was moved."""
    return os.path.relpath(video.resolve(), folder.resolve()) if video.exists() else str(video)


def _write_bird(exported: Exported, n: int, began: datetime.datetime, video: str, path: Path) -> None:
    pynwb, ndx_pose = _library("pynwb"), _library("ndx_pose")
    s, track = exported.solution, int(exported.solution.track_id[n])
    facts = describe_tracks(exported)[str(track)]
    # the same export has the same identifier
    digest = hashlib.sha256(f"{video} {track}".encode() + s.keypoints_px[n].tobytes() + s.valid[n].tobytes()).digest()
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
        rate=exported.require_fps(),
        starting_time=0.0,
        num_samples=int(s.frame_index[-1]) + 1,
        unit="n.a.",
        dimension=s.image_size_px[s.valid].max(0).tolist(),
    )
    file.add_acquisition(footage)
    edges = np.array(skeleton_pairs(s.keypoint_names), np.uint8).reshape(-1, 2)
    skeleton = ndx_pose.Skeleton(name="bird", nodes=list(s.keypoint_names), edges=edges, subject=subject)
    pose = ndx_pose.PoseEstimation(
        name="PoseEstimation",
        pose_estimation_series=_series(exported, n),
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
    with pynwb.NWBHDF5IO(path, "w") as io:
        io.write(file)


def _series(exported: Exported, n: int) -> list[Any]:
    """Return one series for every keypoint. The series share their times."""
    ndx_pose = _library("ndx_pose")
    points, confidence = exported.keypoints_px[n], exported.confidence[n]
    times = exported.times_s
    steps = np.diff(times)
    timing: dict[str, Any] = {"timestamps": times}
    if len(steps) and np.abs(steps - steps[0]).max() < 1e-6:
        timing = {"starting_time": float(times[0]), "rate": float(1 / steps.mean())}
    series: list[Any] = []
    for k, name in enumerate(_series_names(exported.solution.keypoint_names)):
        one = ndx_pose.PoseEstimationSeries(
            name=name,
            description=f"keypoint {one_line(exported.solution.keypoint_names[k])}",
            data=points[:, k],
            unit="pixels",
            reference_frame=_ORIGIN,
            **timing,
            confidence=confidence[:, k],
            confidence_definition=CONFIDENCE,
        )
        if "timestamps" in timing and not series:
            timing = {"timestamps": one}  # a link to the times of the first series
        series.append(one)
    return series


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
