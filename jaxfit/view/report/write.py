"""Write the report of a result."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.result_folder import CONFIG, OBSERVATIONS, check_is_of_video, named_footage, read_summary
from jaxfit.data.solution import Solution, load_solution
from jaxfit.data.world import as_filmed
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_new_file, write_whole
from jaxfit.foundation.reading import reading
from jaxfit.model.bird import Bird
from jaxfit.view.report.contents import gather
from jaxfit.view.report.page import Behaviour, Measured, page, report_pictures

REPORT = "report.html"

_logger = logging.getLogger(__name__)


def write_report(
    path: Path,
    solution: Solution,
    bird: Bird,
    observations: Observations | None,
    summary: Mapping[str, Any],
    config: str,
    folder: Path,
    video: Path | None,
    force: bool = False,
    measured: Sequence[Measured] = (),
    describe: Callable[[], Behaviour | None] = lambda: None,
) -> None:
    """Write the report of a result as one HTML page that needs no other file.

    Args:
        path: file to write.
        solution, bird: the result and its model.
        observations: the detections of the same tracks and frames; None if they are unknown.
        summary: content of `summary.json`.
        config: the config as YAML.
        folder: the folder that holds the result, for commands in the report.
        video: the footage; None writes a report without pictures.
        force: draw also on footage that is not the footage of the result.
        measured: metrics against a known truth.
        describe: returns what the birds do; bouts are links to the footage. None stands for no such section.

    Raises:
        InputError: the footage does not belong to the result, or the file cannot be written.
    """
    report, pictures = gather(solution, observations, summary, config, folder, bird), []
    if video is not None and solution.valid.any():
        filmed, lens = as_filmed(folder, solution, bird)
        pictures = report_pictures(filmed, bird, video, observations, force, lens)
    behaviour = describe()  # last, because the footage may be wrong
    film = None if video is None else film_address(video, path)
    write_whole(path, page(report, pictures, measured, behaviour, film).encode())


def film_address(film: Path, page: Path) -> str | None:
    """Return the address of a film as a page links to it: relative to the page, where possible.

    Args:
        film: the footage. A folder of pictures has no times that a link could name: None.
        page: the file of the page.
    """
    if not film.is_file():
        return None
    film = film.absolute()
    try:
        relative = os.path.relpath(film, page.absolute().parent)
    except ValueError:  # another drive of Windows
        return film.as_uri()
    return quote(Path(relative).as_posix())


def report_of_result(
    folder: str | Path,
    video: str | Path | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    force: bool = False,
    describe: Callable[[Path], Behaviour | None] = lambda _: None,
    measured: Sequence[Measured] = (),
) -> Path:
    """Write the report of a result folder.

    Args:
        folder: folder of `jaxfit reconstruct` or `jaxfit fit`.
        video: the footage; None takes the footage that the result names, if the footage is still there.
        out: file to write; None takes `report.html` in the folder of the result.
        overwrite: replace an existing file. Without `out`, an earlier report of the result is always replaced.
        force: draw also on footage that is not the footage of the result.
        describe: returns what the birds of a result folder do; None stands for no such section.
        measured: metrics against a known truth.

    Returns:
        The written file.

    Raises:
        InputError: the folder holds no result, the files do not belong together, the video cannot be read, or the
            file exists or cannot be written.
    """
    folder = Path(folder)
    path = folder / REPORT if out is None else Path(out)
    check_new_file(path, overwrite or out is None)
    solution, bird = load_solution(folder)
    content = read_summary(folder)
    with reading(folder / CONFIG, "a config") as config_path:
        config = config_path.read_text("utf-8", "replace")
    observations = None
    if (folder / OBSERVATIONS).is_file():
        observations = check_keypoints(read_coco(folder / OBSERVATIONS), bird.keypoint_names, folder / OBSERVATIONS)
        if not np.array_equal(observations.frame_index, solution.frame_index):
            problem = "has other frames than poses.npz, so it belongs to another result"
            raise InputError(folder / OBSERVATIONS, problem, "remove it, or run the reconstruction again")
    if video is not None:
        check_is_of_video(folder, content, "remove --video")
    footage = _footage(content, video)
    of_folder = partial(describe, folder)
    write_report(path, solution, bird, observations, content, config, folder, footage, force, measured, of_folder)
    return path


def _footage(summary: Mapping[str, Any], given: str | Path | None) -> Path | None:
    """Return the footage that is given, or else the footage that the summary names and that still exists."""
    if given is not None:
        return Path(given)
    named = named_footage(summary)
    if named is None or named.exists():
        return named
    _logger.warning("%s: the footage is not there, so the report has no pictures; give --video", named)
    return None
