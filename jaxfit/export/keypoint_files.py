"""2D keypoints for correction by hand, as COCO, SLEAP and DeepLabCut; `jaxfit import` reads the corrected files.

The keypoints are the projected keypoints of the poses, each with confidence 1, because a person corrects all of them. A
frame without a pose has no bird.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.deeplabcut.predictions import write_deeplabcut_predictions
from jaxfit.data.formats.sleap.write_project import write_sleap_project
from jaxfit.data.observations import Observations
from jaxfit.data.projected import projected_observations
from jaxfit.errors import InputError, one_line
from jaxfit.export.result import Exported
from jaxfit.extras import require_package
from jaxfit.progress import ProgressTask
from jaxfit.storage.json_values import json_text

__all__ = ["write_coco_keypoints", "write_dlc_keypoints", "write_slp_keypoints"]


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
        InputError: h5py is not installed, the name has another suffix, or no pose is chosen.
    """
    if out.suffix not in (".h5", ".csv"):
        raise InputError(out, "must end with .h5 or .csv for DeepLabCut", "choose another --out")
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
