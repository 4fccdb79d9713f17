"""Reading of observations in any supported format, which is recognised by the content of the file."""

from __future__ import annotations

import logging
from pathlib import Path

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.coco_records import Untracked
from jaxfit.data.formats.deeplabcut import find_pandas_table, read_deeplabcut_csv, read_deeplabcut_hdf5
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.hdf5 import HDF5_SIGNATURE, open_hdf5
from jaxfit.data.formats.image_sizes import add_times, check_positions, check_video
from jaxfit.data.formats.keypoint_table import KeypointTable, table_observations
from jaxfit.data.formats.label_studio import read_label_studio
from jaxfit.data.formats.sleap import read_sleap_analysis, read_sleap_project, read_with_sleap_io
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.reading import open_file, reading

_log = logging.getLogger(__name__)

_WRITTEN_BY = "check the path; `jaxfit track` and `jaxfit import` write observations"
_FORMATS = (
    "give COCO or Label Studio json, DeepLabCut or Lightning Pose .csv or .h5, SLEAP .slp, .analysis.h5 or .csv, "
    "or AlphaTracker json"
)


def read_observations(
    path: str | Path,
    video: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
    untracked: Untracked = "video",
) -> Observations:
    """Read observations from COCO json, DeepLabCut, Lightning Pose, SLEAP or others; the content tells the format.

    Keypoints keep the names of the file; `jaxfit.data.keypoint_names` maps the names to those of a model. Positions are
    those of the file. Likelihoods and scores become confidences. Files of DeepLabCut and SLEAP have no boxes: a bird
    has the box of its certain keypoints. The log holds one line about the file (`statement`).

    Args:
        path: the file.
        video: the video, or folder of pictures, of the observations. It gives the size of the images where the file
            does not store the size, and the times of the frames where the file does not store times. It must fit to the
            file. None: as the file and its folder say.
        size_px: width and height of the images, in place of `video`, for a file that does not store the size.
        untracked: how a COCO file without any track is read; see `jaxfit.data.formats.coco_records`.

    Raises:
        InputError: the file cannot be read, is of no supported format, is damaged, or does not fit to the video; or
            the extra `formats` is needed and not installed.
    """
    path, video = Path(path), None if video is None else Path(video)
    with open_file(path, "a file of observations", _WRITTEN_BY) as file:
        start = file.read(4096)
    kind, table = _keypoints(path, start, video)
    with reading(path, kind):
        if table is None:
            observations = read_coco(path, video, untracked)
            if video is not None:
                check_video(observations, path, video)
                observations = add_times(observations, video)
        else:
            observations = table_observations(table, path, video, size_px)
        check_positions(observations, path)
    _log.info("%s: %s", path, statement(observations, kind, path))
    return observations


def statement(observations: Observations, kind: str, path: Path) -> str:
    """Return what a file of observations holds, in one line.

    Args:
        observations: the observations.
        kind: the kind of file with its article, such as `a SLEAP project`.
        path: the file.
    """
    N, T = observations.present.shape
    films = sorted({str(name).partition("#")[0] for name in observations.file_name})
    of = films[0] if len(films) == 1 else counted(len(films), "picture") if films else path.stem
    of = "an unknown film" if of == path.stem else of
    width, height = observations.image_size_px[0].tolist() if T else (0, 0)
    numbers = observations.frame_index[[0, -1]].tolist() if T else []
    frames = f"{counted(T, 'frame')} ({numbers[0]} to {numbers[1]})" if T else "no frame"
    count = counted(observations.photographs, "photograph") if observations.photographs else frames
    known, most = int((observations.confidence > 0).sum()), int(observations.present.sum()) * observations.num_keypoints
    keypoints = f"{counted(observations.num_keypoints, 'keypoint')} ({known:,} of {most:,} known)"
    rate = "" if observations.fps is None else f" at {observations.fps:.5g} frames/s"
    held = f"{counted(N, 'bird')}, {count}, {keypoints}, {counted(len(observations.masks), 'mask')}"
    return f"{kind} of {of}, {width}×{height}{rate}: {held}"


def _keypoints(path: Path, start: bytes, video: Path | None) -> tuple[str, KeypointTable | None]:
    """Return the kind of a file with its article, and its table of keypoints; None for COCO, which has more.

    Args:
        path: the file.
        start: its first bytes.
        video: the video whose birds are read, if the file has birds of several videos.
    """
    if start.startswith(HDF5_SIGNATURE):
        return _hdf5_keypoints(path, video)
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:1] == b"[":
        kind = "a file of Label Studio"
        with reading(path, kind):
            content = read_json(path).value
            if content and "data" not in content[0] and "annotations" in content[0]:
                kind = "a file of AlphaTracker"
                return kind, read_with_sleap_io(path, kind, lambda sio, name: sio.load_alphatracker(name), video)
            return kind, read_label_studio(content, path)
    if text[:1] == b"{" or path.suffix.lower() == ".json":
        return "a COCO file", None
    if b"frame_idx" in text.partition(b"\n")[0]:
        kind = "a CSV of SLEAP"
        return kind, read_with_sleap_io(path, kind, lambda sio, name: sio.load_csv(name, format="sleap"), video)
    if text[:6].lower() == b"scorer" or path.suffix.lower() == ".csv":
        return "a CSV of DeepLabCut", read_deeplabcut_csv(path)
    raise InputError(path, "is empty" if not start else "is of no known format", _FORMATS)


def _hdf5_keypoints(path: Path, video: Path | None) -> tuple[str, KeypointTable]:
    """Return kind and keypoints of an HDF5 file, as `_keypoints`."""
    with open_hdf5(path, "an HDF5 file of observations") as file:
        if "tracks" in file and "node_names" in file:
            return "an analysis file of SLEAP", read_sleap_analysis(file, path)
        table = find_pandas_table(file)
        if table is not None:
            return "an HDF5 file of DeepLabCut", read_deeplabcut_hdf5(table, path)
        names = list(file)
    if "instances" in names and "frames" in names:
        return "a SLEAP project", read_sleap_project(path, video)
    held = ", ".join(names[:10]) or "nothing"
    raise InputError(path, f"is an HDF5 file of no known format: it holds {held}", _FORMATS)
