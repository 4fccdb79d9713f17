"""netCDF files for the package movement (`ds_type` = poses).

Source: the layout is that of the poses of movement 0.17, whose dimensions have names in the singular. Versions up to
0.16 have the dimensions `keypoints` and `individuals`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Literal

import numpy as np

from jaxfit.data.frame_numbers import frame_step
from jaxfit.export.result import CONFIDENCE, Exported
from jaxfit.extras import require_package
from jaxfit.progress import ProgressTask
from jaxfit.storage.files import write_whole

__all__ = ["write_movement"]

_READERS = {
    "singular": "movement 0.17 or newer reads this file; for movement 0.16 or older, export with --dims plural",
    "plural": "movement 0.16 or older reads this file; for movement 0.17 or newer, export without --dims plural",
}
"""Names of the dimensions → the versions of movement that read them."""


def write_movement(
    exported: Exported,
    out: Path,
    progress: ProgressTask,
    space: Literal["2d", "3d"] = "2d",
    dims: Literal["singular", "plural"] = "singular",
) -> tuple[list[Path], list[str]]:
    """Write a netCDF file with `position` (time, space, keypoint, individual) and `confidence`.

    Frame numbers that the result lacks between its first and last frame are frames of NaN, so that the frames have
    equal distances in time. The individual of track 3 has the name `bird_3`.

    Args:
        exported: the result.
        out: the file to write.
        progress: shows progress.
        space: `2d` for image pixels, `3d` for the camera frame of the image.
        dims: `singular` for the dimensions `keypoint` and `individual`, `plural` for `keypoints` and `individuals`.

    Returns:
        The file, and a note about the versions of movement that read the file.

    Raises:
        InputError: xarray or h5netcdf is not installed, or the frame rate is unknown.
    """
    for package in ("xarray", "h5netcdf"):
        require_package(package, "--to movement")
    import xarray

    s, fps = exported.solution, exported.sampling_fps
    numbers = np.arange(s.frame_index[0], s.frame_index[-1] + 1, frame_step(s.frame_index))
    column = np.searchsorted(numbers, s.frame_index)
    points = exported.keypoints_px if space == "2d" else exported.keypoints_3d
    position = np.full((len(numbers), points.shape[3], points.shape[2], points.shape[0]), np.nan, np.float32)
    position[column] = points.transpose(1, 3, 2, 0)
    confidence = np.full((len(numbers), *position.shape[2:]), np.nan, np.float32)
    confidence[column] = exported.confidence.transpose(1, 2, 0)
    keypoint, individual = ("keypoint", "individual") if dims == "singular" else ("keypoints", "individuals")
    with progress("Writing netCDF", None):
        dataset = xarray.Dataset(
            {
                "position": (("time", "space", keypoint, individual), position, {"units": _unit(exported, space)}),
                "confidence": (("time", keypoint, individual), confidence, {"description": CONFIDENCE}),
                "status": ((individual,), s.status.astype(str), {"description": "how the fit of the track ended"}),
                **_quality(exported, individual),
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
                "position_frame": "image, x right, y down" if space == "2d" else "camera frame of the image, z forward",
                **({} if space == "2d" else {"focal_length_px": exported.focal_px}),
            },
        )
        content = io.BytesIO()
        compressed = {"zlib": True, "complevel": 4}
        dataset.to_netcdf(
            content, engine="h5netcdf", encoding={name: compressed for name in ("position", "confidence")}
        )
        write_whole(out, content.getvalue())
    return [out], [_READERS[dims]]


def _quality(exported: Exported, individual: str) -> dict[str, tuple]:
    """Return the quality of the tracks, if the result has detections."""
    if not exported.quality:
        return {}
    rows = [exported.quality.get(track) for track in exported.solution.track_id.tolist()]
    names = ("coverage", "mean_confidence")
    values = {name: np.array([np.nan if row is None else getattr(row, name) for row in rows]) for name in names}
    return {f"track_{name}": ((individual,), column) for name, column in values.items()}


def _unit(exported: Exported, space: str) -> str:
    return "pixels" if space == "2d" else {"m": "metres", "unit": "model units"}[exported.unit]
