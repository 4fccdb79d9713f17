"""Checks of an overlay: video, result and observations agree, and the output files may be written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.storage.files import check_new_file
from jaxfit.video.reader import VideoInfo

__all__ = ["check_belongs", "check_outputs", "is_inside", "too_short"]

_REMEDY = "give the video that the result was fitted to"


def check_belongs(solution: Solution, observations: Observations | None, video: Path, info: VideoInfo) -> None:
    """Raise InputError where the result, the video and the observations do not have the same frames and image sizes."""
    if not solution.valid.any():
        raise InputError("result", "holds no valid pose, so there is nothing to draw", "see the status of each track")
    if info.frames is not None and int(solution.frame_index[-1]) >= info.frames:
        raise too_short(video, solution, info.frames)
    width, height = info.size_px
    sizes = solution.image_size_px[solution.valid]
    other = sizes[(sizes != info.size_px).any(1)]
    if len(other):
        problem = f"is {width}×{height}, but the result was fitted to images of {other[0, 0]}×{other[0, 1]}"
        raise InputError(video, problem, _REMEDY)
    if observations is None:
        return
    remedy = "give the file that the result was fitted to"
    if not (
        np.isin(solution.track_id, observations.track_id).any()
        and np.isin(solution.frame_index, observations.frame_index).any()
    ):
        problem = "hold no bird of the result: they share no track id or no frame number"
        raise InputError("observations", problem, remedy)
    seen = tuple(int(side) for side in observations.image_size_px[0])
    if seen != info.size_px:
        problem = f"are of {seen[0]}×{seen[1]} images, but the video is {width}×{height}"
        raise InputError("observations", problem, remedy)


def check_outputs(outputs: list[Path], video: Path, overwrite: bool) -> None:
    """Raise InputError where an output file would replace the footage, or another file without `overwrite`.

    Args:
        outputs: the files to write.
        video: the footage, a file or a folder of images; outputs must not replace it or lie in the folder.
        overwrite: whether other files may be replaced.
    """
    for out in outputs:
        if out.exists() and out.samefile(video):
            raise InputError(out, "is the video itself, which would be lost", "choose another --out")
        if video.is_dir() and is_inside(out, video):
            raise InputError(out, f"lies among the video's images in {video}", "choose an --out elsewhere")
        check_new_file(out, overwrite)


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder, also through symbolic links; a cyclic link lies nowhere."""
    # `Path.resolve` raises an error for cyclic links
    return Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def too_short(video: Path, solution: Solution, frames: int) -> InputError:
    """Return the error about a video with fewer frames than the result."""
    first, last = int(solution.frame_index[0]), int(solution.frame_index[-1])
    problem = f"has {frames} frames, but the result has frames {first} to {last}, counted from 0"
    return InputError(video, problem, _REMEDY)
