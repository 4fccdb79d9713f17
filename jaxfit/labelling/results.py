"""The result that frames are chosen from: observations of a video, and the fit of its birds."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from jaxfit.data.formats.image_sizes import check_video
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.observations import Observations
from jaxfit.data.projected import projected_observations
from jaxfit.data.solution import Solution, load_solution
from jaxfit.errors import InputError

__all__ = ["Result", "read_result"]

_OBSERVATIONS = "observations.json"


class Result(NamedTuple):
    """What is known about the birds of a video."""

    observations: Observations
    solution: Solution | None
    """The fit of the observations, if there is a fit."""


def read_result(path: Path, video: Path) -> Result:
    """Read a result folder or a file of observations, and check that the result belongs to a video.

    The observations of a folder without `observations.json`, which `jaxfit fit` writes, are the projected keypoints.

    Args:
        path: a folder of `jaxfit reconstruct` or `jaxfit fit`, or a file of observations in any format.
        video: the video, or folder of pictures.

    Raises:
        InputError: the result cannot be read, has images of another size or frames that the video lacks, or consists
            of photographs.
    """
    solution = None
    if path.is_dir():
        solution, _ = load_solution(path)
        if (path / _OBSERVATIONS).is_file():
            observations = read_observations(path / _OBSERVATIONS, video)
        else:
            observations, solution = projected_observations(solution), None
            check_video(observations, path, video)
    else:
        observations = read_observations(path, video)
    if observations.own_images:
        raise InputError(path, "holds photographs, not frames of one video", "give the result of this video")
    if not observations.num_frames:
        raise InputError(path, "holds no frames", "give the result of this video")
    return Result(observations, solution)
