"""Predictions of DeepLabCut for several animals: one row for every frame, named by its number.

Every track is an individual `birdN` with the track id N. A missing keypoint is an empty cell with likelihood 0.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from jaxfit.data.formats.deeplabcut.pandas_table import COLUMN_LEVELS, write_pandas_table
from jaxfit.data.observations import Observations
from jaxfit.storage.files import write_whole

__all__ = ["write_deeplabcut_predictions"]


def write_deeplabcut_predictions(observations: Observations, path: str | Path, scorer: str = "jaxfit") -> None:
    """Write observations as predictions, with the confidences as likelihoods.

    Args:
        observations: the observations; tracks without a bird are left out.
        path: a `.csv`, else an HDF5 file; an existing file is replaced.
        scorer: name of the program that predicts.

    Raises:
        InputError: the file is HDF5 and the extra `formats` is not installed, or the file cannot be written.
    """
    path = Path(path)
    kept = np.flatnonzero(observations.present.any(1))
    names, coords = observations.keypoint_names, ("x", "y", "likelihood")
    birds = [f"bird{track}" for track in observations.track_id[kept].tolist()]
    columns = [(scorer, bird, name, coord) for bird in birds for name in names for coord in coords]
    confidence = observations.confidence[kept][..., None]
    points = np.where(confidence > 0, observations.keypoints_px[kept], np.float32(np.nan))
    values = np.concatenate([points, confidence], axis=-1).transpose(1, 0, 2, 3).reshape(observations.num_frames, -1)
    values = values.astype(str).astype(np.float64)  # the shortest digits that give the same float32
    if path.suffix == ".csv":
        write_whole(path, _csv(columns, observations.frame_index, values).encode())
    else:
        write_pandas_table(path, columns, observations.frame_index, values)


def _csv(columns: list[tuple[str, ...]], frames: np.ndarray, values: np.ndarray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, level in enumerate(COLUMN_LEVELS):
        writer.writerow([level, *(column[i] for column in columns)])
    cells = np.where(np.isnan(values), "", values.astype(str))
    writer.writerows([str(frame), *row] for frame, row in zip(frames.tolist(), cells.tolist(), strict=True))
    return text.getvalue()
