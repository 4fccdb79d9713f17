"""Checks of an overlay: video, result and observations agree, and the output files may be written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxfit.data.footage import FootageIdentity, read_footage
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.storage.files import check_new_file
from jaxfit.video.reader import VideoInfo

__all__ = ["check_belongs", "check_outputs", "is_inside", "too_short"]

_REMEDY = "give the video that the result was fitted to, or draw on this video all the same by --force"


def check_belongs(
    solution: Solution, observations: Observations | None, video: Path, info: VideoInfo, force: bool = False
) -> None:
    """Raise InputError where the result, the video and the observations do not belong together.

    Args:
        solution: the result.
        observations: the observations to draw.
        video: the video to draw on.
        info: its properties.
        force: accept another video than the video of the result, and observations of other image sizes.
    """
    if not solution.valid.any():
        raise InputError("result", "holds no valid pose, so there is nothing to draw", "see the status of each track")
    differences = [] if force else _differences(solution, video, info)
    if differences:
        raise InputError(video, f"is not the video of the result: it has {', '.join(differences)}", _REMEDY)
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
    if seen != info.size_px and not force:
        width, height = info.size_px
        problem = f"are of {seen[0]}×{seen[1]} images, but the video is {width}×{height}"
        raise InputError("observations", problem, remedy)


def _differences(solution: Solution, video: Path, info: VideoInfo) -> list[str]:
    """Return how a video differs from the video of the result, as far as both are known."""
    known, texts = solution.footage or FootageIdentity(), []
    sizes = solution.image_size_px[solution.valid]
    other = sizes[(sizes != info.size_px).any(1)]
    if len(other):
        texts.append(f"images of {info.size_px[0]}×{info.size_px[1]} instead of {other[0, 0]}×{other[0, 1]} pixels")
    if None not in (info.frames, known.frames) and info.frames != known.frames:
        texts.append(f"{info.frames} frames instead of {known.frames}")
    elif info.frames is not None and int(solution.frame_index[-1]) >= info.frames:
        texts.append(_too_few(solution, info.frames))
    if known.first_frame is not None and known.differs(read_footage(video, info.frames)):
        texts.append("another first frame")
    return texts


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
    return InputError(video, f"has {_too_few(solution, frames)}", _REMEDY)


def _too_few(solution: Solution, frames: int) -> str:
    first, last = int(solution.frame_index[0]), int(solution.frame_index[-1])
    return f"{frames} frames, but the result has frames {first} to {last}, counted from 0"
