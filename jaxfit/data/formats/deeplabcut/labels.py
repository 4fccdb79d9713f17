"""Labels for DeepLabCut: `CollectedData_SCORER.csv` and `.h5` of several animals, written without pickles.

Every track is an individual `birdN` with the track id N. A keypoint without a position is an empty cell. DeepLabCut has
no place for confidences, hidden keypoints, boxes and masks.

Source: the layout of the `.h5` is that of `DataFrame.to_hdf` of pandas 3 (`format="fixed"`), which DeepLabCut reads.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.extras import require_extra
from jaxfit.storage.files import write_whole

__all__ = ["write_deeplabcut_labels"]

_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
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
    _write_hdf5(path.with_name(path.name + ".h5"), columns, rows, values)


def _csv(columns: list[tuple[str, ...]], rows: list[tuple[str, ...]], values: np.ndarray) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, level in enumerate(_LEVELS):
        writer.writerow([level, "", "", *(column[i] for column in columns)])
    for row, numbers in zip(rows, values, strict=True):
        writer.writerow([*row, *("" if np.isnan(number) else str(number) for number in numbers)])
    return text.getvalue()


def _write_hdf5(path: Path, columns: list[tuple[str, ...]], rows: list[tuple[str, ...]], values: np.ndarray) -> None:
    require_extra("formats", str(path))
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        _describe(file, "GROUP", PYTABLES_FORMAT_VERSION="2.1")
        table = file.create_group("df_with_missing")
        counts = {"nblocks": 1, "ndim": 2} | {f"{axis}_nlevels": 4 for axis in ("axis0", "block0_items")}
        _describe(table, "GROUP", pandas_type="frame", encoding="UTF-8", errors="strict", axis1_nlevels=3, **counts)
        for axis, entries, names in (
            ("axis0", columns, _LEVELS),
            ("block0_items", columns, _LEVELS),
            ("axis1", rows, ()),
        ):
            _describe(table, "GROUP", **{f"{axis}_variety": "multi"})
            _write_axis(table, axis, entries, names)
        table["block0_values"] = values
        _describe(table["block0_values"], "ARRAY", transposed=1)
    write_whole(path, content.getvalue())


def _write_axis(table: Any, axis: str, entries: list[tuple[str, ...]], names: Sequence[str]) -> None:
    """Write the names along an axis: for each level, the different texts and the position of every entry's text."""
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
