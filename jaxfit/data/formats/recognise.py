"""Reading of observations in any supported format, which is recognised by the content of the file."""

from __future__ import annotations

from pathlib import Path

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.coco_records import Untracked
from jaxfit.data.formats.deeplabcut import find_pandas_table, read_deeplabcut_csv, read_deeplabcut_hdf5
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.hdf5 import HDF5_SIGNATURE, open_hdf5
from jaxfit.data.formats.image_sizes import add_times, check_video
from jaxfit.data.formats.keypoint_table import KeypointTable, table_observations
from jaxfit.data.formats.label_studio import read_label_studio
from jaxfit.data.formats.sleap import read_sleap_analysis, read_sleap_project
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import open_file

_WRITTEN_BY = "check the path; `jaxfit track` and `jaxfit import` write observations"
_FORMATS = (
    "give COCO or Label Studio json, DeepLabCut or Lightning Pose .csv, DeepLabCut .h5, SLEAP .slp or .analysis.h5"
)


def read_observations(
    path: str | Path,
    video: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
    untracked: Untracked = "video",
) -> Observations:
    """Read observations from COCO json, DeepLabCut, Lightning Pose or SLEAP; the content tells the format.

    Keypoints keep the names of the file; `jaxfit.data.keypoint_names` maps the names to those of a model. Positions are
    those of the file. Likelihoods and scores become confidences. Files of DeepLabCut and SLEAP have no boxes: a bird
    has the box of its certain keypoints.

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
    if start.startswith(HDF5_SIGNATURE):
        return table_observations(_read_hdf5(path, video), path, video, size_px)
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:1] == b"[":
        return table_observations(read_label_studio(read_json(path)), path, video, size_px)
    if text[:1] == b"{" or path.suffix.lower() == ".json":
        observations = read_coco(path, video, untracked)
        if video is not None:
            check_video(observations, path, video)
            observations = add_times(observations, video)
        return observations
    if text[:6].lower() == b"scorer" or path.suffix.lower() == ".csv":
        return table_observations(read_deeplabcut_csv(path), path, video, size_px)
    raise InputError(path, "is empty" if not start else "is of no known format", _FORMATS)


def _read_hdf5(path: Path, video: Path | None) -> KeypointTable:
    with open_hdf5(path) as root:
        if "instances" in root and "frames" in root:
            return read_sleap_project(root, path, video)
        if "tracks" in root and "node_names" in root:
            return read_sleap_analysis(root, path)
        table = find_pandas_table(root)
        if table is not None:
            return read_deeplabcut_hdf5(table, path)
        names = ", ".join(root.names()[:10]) or "nothing"
        raise InputError(path, f"is an HDF5 file of no known format: it holds {names}", _FORMATS)
