"""Writer of labels and predictions of DeepLabCut, without pickles.

Source: the layout is that of `DataFrame.to_hdf` of pandas 3 (`format="fixed"`), which DeepLabCut reads.

Labels for DeepLabCut: `CollectedData_SCORER.csv` and `.h5` of several animals, written without pickles. Every track is
an individual `birdN` with the track id N. A keypoint without a position is an empty cell. DeepLabCut has no place for
confidences, hidden keypoints, boxes and masks.

Predictions of DeepLabCut for several animals: one row for every frame, named by its number. Every track is an
individual `birdN` with the track id N. A missing keypoint is an empty cell with likelihood 0.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import write_whole

COLUMN_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
"""Levels of the columns of a table with several animals."""


def write_pandas_table(
    path: Path, columns: Sequence[tuple[str, ...]], rows: Sequence[tuple[str, ...]] | np.ndarray, values: np.ndarray
) -> None:
    """Write a table of DeepLabCut as HDF5.

    Args:
        path: the file; an existing file is replaced.
        columns: the texts of `COLUMNCOLUMN_LEVELS` of every column.
        rows: three texts of every row (labels), or the frame number of every row (predictions).
        values: (rows, columns) float64.

    Raises:
        InputError: the extra `formats` is not installed, or the file cannot be written.
    """
    require_extra("formats", str(path), "h5py")
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        _describe(file, "GROUP", PYTABLES_FORMAT_VERSION="2.1")
        table = file.create_group("df_with_missing")
        counts = {"nblocks": 1, "ndim": 2} | {f"{axis}_nlevels": 4 for axis in ("axis0", "block0_items")}
        _describe(table, "GROUP", pandas_type="frame", encoding="UTF-8", errors="strict", **counts)
        for axis in ("axis0", "block0_items"):
            _write_axis(table, axis, columns, COLUMN_LEVELS)
        if isinstance(rows, np.ndarray):
            _describe(table, "GROUP", axis1_variety="regular")
            table["axis1"] = rows.astype(np.int64)
            _describe(table["axis1"], "ARRAY", transposed=1, kind="integer", name="N.")
        else:
            _describe(table, "GROUP", axis1_nlevels=3)
            _write_axis(table, "axis1", rows, ())
        table["block0_values"] = values
        _describe(table["block0_values"], "ARRAY", transposed=1)
    write_whole(path, content.getvalue())


def _write_axis(table: Any, axis: str, entries: Sequence[tuple[str, ...]], names: Sequence[str]) -> None:
    """Write the names along an axis: for each level, the different texts and the position of every entry's text."""
    _describe(table, "GROUP", **{f"{axis}_variety": "multi"})
    for i in range(len(names) or 3):
        own = [entry[i] for entry in entries]
        texts = list(dict.fromkeys(own))
        place = {text: k for k, text in enumerate(texts)}
        level, label = f"{axis}_level{i}", f"{axis}_label{i}"
        table[level] = np.array([text.encode() for text in texts] or [b""], "S")[: len(texts)]
        table[label] = np.array([place[text] for text in own], np.int32)
        named = {"name": names[i], f"{axis}_name{names[i]}": names[i]} if names else {}
        _describe(table[level], "ARRAY", transposed=1, kind="string", nan_rep="nan", **named)
        _describe(table[label], "ARRAY", transposed=1)


def _describe(entry: Any, node: str, **attributes: str | int) -> None:
    """Write the attributes that PyTables and pandas need; PyTables reads text with the character set UTF-8 as `str`."""
    import h5py

    version = {"GROUP": "1.0", "ARRAY": "2.4"}[node]
    flavour = {"FLAVOR": "numpy"} if node == "ARRAY" else {}
    for name, value in ({"CLASS": node, "VERSION": version} | flavour | attributes).items():
        if isinstance(value, str):
            entry.attrs.create(name, value.encode(), dtype=h5py.string_dtype("utf-8", len(value.encode())))
        else:
            entry.attrs[name] = np.uint8(value) if name == "transposed" else np.int64(value)


_FOLDER = "labeled-data"


def write_deeplabcut_labels(
    observations: Observations, pictures: Sequence[str], folder: str | Path, scorer: str = "jaxfit"
) -> None:
    """Write labels into the folder of their pictures, as `CollectedData_SCORER.csv` and `CollectedData_SCORER.h5`.

    Without any bird, the columns are those of an individual `bird1` without labels, so that the header has all names.

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
    birds = [f"bird{track}" for track in observations.track_id[kept].tolist()] or ["bird1"]
    columns = [(scorer, bird, name, axis) for bird in birds for name in observations.keypoint_names for axis in "xy"]
    known = observations.confidence[kept] > 0
    shortest = observations.keypoints_px[kept].astype(str).astype(np.float64)  # the same numbers in both files
    points = np.where(known[..., None], shortest, np.nan)
    values = points.transpose(1, 0, 2, 3).reshape(len(pictures), -1)  # one row per frame: bird, keypoint, x and y
    values = values if len(kept) else np.full((len(pictures), len(columns)), np.nan)
    rows = [(_FOLDER, folder.name, picture) for picture in pictures]
    path = folder / f"CollectedData_{scorer}"
    write_whole(path.with_name(path.name + ".csv"), _labels_csv(columns, rows, values).encode())
    write_pandas_table(path.with_name(path.name + ".h5"), columns, rows, values)


def _labels_csv(columns: list[tuple[str, ...]], rows: list[tuple[str, ...]], values: np.ndarray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, level in enumerate(COLUMN_LEVELS):
        writer.writerow([level, "", "", *(column[i] for column in columns)])
    for row, numbers in zip(rows, values, strict=True):
        writer.writerow([*row, *("" if np.isnan(number) else str(number) for number in numbers)])
    return text.getvalue()


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
        write_whole(path, _predictions_csv(columns, observations.frame_index, values).encode())
    else:
        write_pandas_table(path, columns, observations.frame_index, values)


def _predictions_csv(columns: list[tuple[str, ...]], frames: np.ndarray, values: np.ndarray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, level in enumerate(COLUMN_LEVELS):
        writer.writerow([level, *(column[i] for column in columns)])
    cells = np.where(np.isnan(values), "", values.astype(str))
    writer.writerows([str(frame), *row] for frame, row in zip(frames.tolist(), cells.tolist(), strict=True))
    return text.getvalue()
