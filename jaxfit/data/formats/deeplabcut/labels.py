"""Labels for DeepLabCut: `CollectedData_SCORER.csv` and `.h5` of several animals, written without pickles.

Every track is an individual `birdN` with the track id N. A keypoint without a position is an empty cell. DeepLabCut has
no place for confidences, hidden keypoints, boxes and masks.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.formats.deeplabcut.pandas_table import COLUMN_LEVELS, write_pandas_table
from jaxfit.data.observations import Observations
from jaxfit.storage.files import write_whole

__all__ = ["write_deeplabcut_labels"]

_FOLDER = "labeled-data"


def write_deeplabcut_labels(
    observations: Observations, pictures: Sequence[str], folder: str | Path, scorer: str = "jaxfit"
) -> None:
    """Write labels into the folder of their pictures, as `CollectedData_SCORER.csv` and `CollectedData_SCORER.h5`.

    Args:
        observations: the labels; tracks without a bird are left out.
        pictures: T names of the pictures of the frames.
        folder: the folder `labeled-data/VIDEO` of a project of DeepLabCut; its name is that of the video.
        scorer: name of the person or program that labels.

    Raises:
        InputError: the extra `formats` is not installed, or a file cannot be written.
    """
    folder = Path(folder)
    kept = np.flatnonzero(observations.present.any(1))
    birds = [f"bird{track}" for track in observations.track_id[kept].tolist()]
    columns = [(scorer, bird, name, axis) for bird in birds for name in observations.keypoint_names for axis in "xy"]
    known = observations.confidence[kept] > 0
    shortest = observations.keypoints_px[kept].astype(str).astype(np.float64)  # the same numbers in both files
    points = np.where(known[..., None], shortest, np.nan)
    values = points.transpose(1, 0, 2, 3).reshape(len(pictures), -1)  # one row per frame: bird, keypoint, x and y
    rows = [(_FOLDER, folder.name, picture) for picture in pictures]
    path = folder / f"CollectedData_{scorer}"
    write_whole(path.with_name(path.name + ".csv"), _csv(columns, rows, values).encode())
    write_pandas_table(path.with_name(path.name + ".h5"), columns, rows, values)


def _csv(columns: list[tuple[str, ...]], rows: list[tuple[str, ...]], values: np.ndarray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, level in enumerate(COLUMN_LEVELS):
        writer.writerow([level, "", "", *(column[i] for column in columns)])
    for row, numbers in zip(rows, values, strict=True):
        writer.writerow([*row, *("" if np.isnan(number) else str(number) for number in numbers)])
    return text.getvalue()
