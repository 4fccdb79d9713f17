"""Labels and predictions for DeepLabCut, with several animals.

Every track is an individual `birdN` with the track id N. A keypoint without a position is an empty cell; predictions
give it the likelihood 0. DeepLabCut has no place for hidden keypoints, boxes and masks, and labels have no confidences.

HDF5 files have the layout of `DataFrame.to_hdf` of pandas 3 (`format="fixed"`), written by h5py: sleap-io 0.9 writes no
HDF5 of DeepLabCut, and pandas needs PyTables.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.formats.deeplabcut import COLUMN_LEVELS
from jaxfit.data.observations import Observations
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import write_whole

Rows = Sequence[tuple[str, str, str]] | np.ndarray
"""Names of rows: `labeled-data`, folder and picture (labels), or the frame numbers (predictions)."""


def _write_hdf5(path: Path, columns: Sequence[tuple[str, ...]], rows: Rows, values: np.ndarray) -> None:
    """Write a table as HDF5; arguments as `_write_csv`."""
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
        names_of_level = [entry[i] for entry in entries]
        texts = list(dict.fromkeys(names_of_level))
        place = {text: k for k, text in enumerate(texts)}
        level, label = f"{axis}_level{i}", f"{axis}_label{i}"
        table[level] = np.array([text.encode() for text in texts] or [b""], "S")[: len(texts)]
        table[label] = np.array([place[text] for text in names_of_level], np.int32)
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
    rows = [("labeled-data", folder.name, picture) for picture in pictures]
    path = folder / f"CollectedData_{scorer}"
    _write_csv(path.with_name(path.name + ".csv"), columns, rows, values)
    _write_hdf5(path.with_name(path.name + ".h5"), columns, rows, values)


def _write_csv(path: Path, columns: Sequence[tuple[str, ...]], rows: Rows, values: np.ndarray) -> None:
    """Write a table as CSV.

    Args:
        path: the file; an existing file is replaced.
        columns: the texts of `COLUMN_LEVELS` of every column.
        rows: the name of every row.
        values: (rows, columns) float64; NaN is an empty cell.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [(str(row),) for row in rows] if isinstance(rows, np.ndarray) else list(rows)
    empty = [""] * (len(names[0]) - 1 if names else 0)
    for i, level in enumerate(COLUMN_LEVELS):
        writer.writerow([level, *empty, *(column[i] for column in columns)])
    cells = np.where(np.isnan(values), "", values.astype(str))
    writer.writerows([*name, *row] for name, row in zip(names, cells.tolist(), strict=True))
    write_whole(path, text.getvalue().encode())


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
    write = _write_csv if path.suffix == ".csv" else _write_hdf5
    write(path, columns, observations.frame_index, values)
