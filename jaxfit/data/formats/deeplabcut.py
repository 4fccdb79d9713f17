"""Files of DeepLabCut and Lightning Pose: CSV and HDF5.

Columns have the levels scorer, individuals (only for several animals), bodyparts and coords. Every individual becomes a
bird. The individual `single`, which holds the keypoints of the scene, is skipped. Coords other than x, y and likelihood
are skipped too, such as the variances that Lightning Pose writes. A row is named by a frame number (predictions) or by
a picture (labels), in newer labels by three texts: `labeled-data`, the folder, the picture. An empty cell is a missing
keypoint.

HDF5 files are tables of pandas, stored by PyTables in two layouts. In the layout `table`, one compound array holds the
rows, and pickled attributes hold the names of the columns. In the layout `fixed`, arrays hold the values, and further
arrays hold the names.

sleap-io 0.9 and pandas do not replace this reader: sleap-io reads no HDF5 of DeepLabCut, and no frame of a CSV of
predictions; pandas needs PyTables and runs the pickles.
"""

from __future__ import annotations

import csv
import io
import pickle
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.formats.hdf5 import hdf5_text
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.reading import open_file

COORDS = ("x", "y", "likelihood")
"""The last levels of the columns that are read."""
COLUMN_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
"""Levels of the columns of a table with several animals."""
_SCENE = "single"
_REMEDY = "give the file that DeepLabCut or Lightning Pose writes"


def keypoint_table(
    columns: Sequence[tuple[str, ...]], values: np.ndarray, row_names: Sequence[str], source: Path
) -> KeypointTable:
    """Return the table of keypoints of labelled columns.

    Args:
        columns: the 3 or 4 levels of every column.
        values: (T, columns) numbers.
        row_names: T frame numbers or names of pictures.
        source: the file, for messages.

    Raises:
        InputError: rows of both kinds, no column of positions, a column twice, a keypoint without x or y, or
            positions in space.
    """
    coords, known = dict.fromkeys(levels[-1] for levels in columns), set(columns)
    if any(known >= {(*levels[:-1], coord) for coord in "xyz"} for levels in columns):
        problem = "holds positions in space (x, y, z), not positions in an image"
        raise InputError(source, problem, "give the file of keypoints of one camera")
    place: dict[tuple[str, str, str], int] = {}
    for i, levels in enumerate(columns):
        bird, keypoint, coord = levels[-3:] if len(levels) == 4 else ("", *levels[-2:])
        if coord not in COORDS or (bird == _SCENE and len(levels) == 4):
            continue
        if (bird, keypoint, coord) in place:
            other = " of a second scorer" if columns[place[bird, keypoint, coord]][0] != levels[0] else ""
            problem = f"holds the column {coord} of {keypoint} twice{f' for {bird}' if bird else ''}{other}"
            raise InputError(source, problem, "keep one column")
        place[bird, keypoint, coord] = i
    if not place:
        problem = f"has no columns x and y of a bird, only {', '.join(coords) or 'none'}"
        raise InputError(source, problem, "give poses or labels")
    birds = tuple(dict.fromkeys(bird for bird, _, _ in place))
    names = tuple(dict.fromkeys(keypoint for _, keypoint, _ in place))
    check_table_size(source, len(birds), len(values), len(names))
    keypoints = np.full((len(birds), len(values), len(names), 2), np.nan, np.float32)
    certain = not any(coord == "likelihood" for _, _, coord in place)
    confidence = np.ones(keypoints.shape[:-1], np.float32)
    with np.errstate(over="ignore"):
        for (bird, keypoint, coord), i in place.items():
            n, k = birds.index(bird), names.index(keypoint)
            for needed in ("x", "y"):
                if (bird, keypoint, needed) not in place:
                    problem = f"has no column {needed} of {keypoint}"
                    raise InputError(source, problem, "every keypoint needs the columns x and y")
            if coord == "likelihood":
                confidence[n, :, k] = values[:, i]
            else:
                keypoints[n, :, k, COORDS.index(coord)] = values[:, i]
    whole = [re.fullmatch(r"(\d+)(\.0+)?", name, re.ASCII) for name in row_names]
    numbered = [match is not None for match in whole] or [True]
    if any(numbered) and not all(numbered):
        problem = f"names its row {numbered.index(True) + 1} by a number, and row {numbered.index(False) + 1} otherwise"
        raise InputError(source, problem, "name all rows by frame numbers or by pictures")
    return KeypointTable(
        names,
        tuple(bird or "bird" for bird in birds),
        keypoints,
        None if certain else confidence,
        frame_index=np.array([match[1] for match in whole if match], np.int64) if numbered[0] else None,
        pictures=None if numbered[0] else tuple(row_names),
        rows_of_frames=numbered[0],
    )


def read_deeplabcut_csv(path: Path) -> KeypointTable:
    """Read a CSV file of DeepLabCut or Lightning Pose.

    Raises:
        InputError: the file cannot be read, a header row is missing, or a cell is not a number.
    """
    header: list[list[str]] = []
    names: list[str] = []
    rows: list[np.ndarray] = []
    used: list[int] = []
    with open_file(path, "a CSV file") as file:
        lines = csv.reader(io.TextIOWrapper(file, encoding="utf-8-sig", newline=""), strict=True)
        try:
            for cells in filter(any, lines):
                if not names and len(header) < len(COLUMN_LEVELS) and cells[0].strip().lower() in COLUMN_LEVELS:
                    header.append(cells)
                    continue
                if not used:
                    _check_header(path, header, cells)
                    # the cells of the header are empty above the names of the rows
                    named = next((i for i, cell in enumerate(header[-1][1:], 1) if cell.strip()), len(header[-1]))
                    used = [i for i in range(named, len(header[-1])) if header[-1][i].strip() in (*COORDS, "z")]
                    if len(cells) == len(header[0]) and not (
                        any(cells[named:]) or cells[0].isdecimal() or "." in cells[named - 1]
                    ):
                        continue  # names of the index, which some programs write
                if len(cells) != len(header[0]):
                    problem = f"line {lines.line_num} has {counted(len(cells), 'cell')}, not {len(header[0])}"
                    raise InputError(path, problem, "the file may end midway: copy or write it again")
                names.append("/".join(cell.strip() for cell in cells[:named] if cell.strip()))
                rows.append(np.array([float(cells[i]) if cells[i] else np.nan for i in used]))
        except UnicodeDecodeError as error:
            raise InputError(path, "is not UTF-8 text", "give a CSV file, saved as UTF-8") from error
        except csv.Error as error:
            raise InputError(path, f"is not valid CSV: {error}", _REMEDY) from error
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            problem = f"line {lines.line_num}: {error}"
            raise InputError(path, problem, "write a number, or leave the cell empty") from None
    if not rows:
        _check_header(path, header, [""])
        raise InputError(path, "holds no frames", "choose another file")
    columns = [tuple(cells[i].strip() for cells in header) for i in used]
    return keypoint_table(columns, np.array(rows).reshape(len(rows), len(used)), names, path)


def _check_header(path: Path, header: Sequence[list[str]], first: list[str]) -> None:
    """Raise InputError if the header is not that of DeepLabCut; `first` is the line that follows."""
    levels = tuple(cells[0].strip().lower() for cells in header)
    if "scorer" not in levels:
        begins = (header[0] if header else first)[0][:40]
        raise InputError(path, f"has no scorer row: its first line begins with {begins!r}", _REMEDY)
    if levels not in (COLUMN_LEVELS, (COLUMN_LEVELS[0], *COLUMN_LEVELS[2:])):
        problem = f"begins with the rows {', '.join(levels)}, not with scorer, (individuals,) bodyparts, coords"
        raise InputError(path, problem, _REMEDY)
    counts = [len(cells) for cells in header]
    if len(set(counts)) > 1:
        problem = f"has header rows of {', '.join(map(str, counts))} cells, which must be equal"
        raise InputError(path, problem, _REMEDY)


def find_pandas_table(file: Any) -> Any | None:
    """Return the first folder of an HDF5 file that holds a table of pandas, or None."""
    tables = (entry for entry in file.values() if hdf5_text(entry.attrs.get("pandas_type")) in ("frame", "frame_table"))
    return next(tables, None)


def read_deeplabcut_hdf5(table: Any, path: Path) -> KeypointTable:
    """Read the table of an HDF5 file of DeepLabCut.

    Args:
        table: the folder of the table, as `find_pandas_table` returns it.
        path: the file, for messages.

    Raises:
        InputError: the table holds no poses.
    """
    columns: list[tuple[str, ...]] = []
    blocks: list[np.ndarray] = []
    if hdf5_text(table.attrs["pandas_type"]) == "frame_table":
        rows = table["table"][()]
        names = [hdf5_text(name) for name in rows["index"].tolist()]
        for block in sorted(name for name in rows.dtype.names if name.startswith("values_block_")):
            blocks.append(rows[block].reshape(len(rows), -1))
            columns += _Literals(io.BytesIO(table["table"].attrs[f"{block}_kind"])).load()
    else:
        names = ["/".join(levels) for levels in _axis(table, "axis1")]
        for b in range(int(table.attrs["nblocks"])):
            blocks.append(table[f"block{b}_values"][()])
            columns += _axis(table, f"block{b}_items")
    if not columns or any(len(levels) not in (3, 4) or len(levels) != len(columns[0]) for levels in columns):
        problem = "has other columns than those of scorer, (individuals,) bodyparts, coords"
        raise InputError(path, problem, f"{_REMEDY}, or its .csv")
    values = np.concatenate(blocks, axis=1).astype(np.float64)
    if values.shape != (len(names), len(columns)):
        problem = f"holds {values.shape[0]}×{values.shape[1]} values for {len(names)} rows and {len(columns)} columns"
        raise InputError(path, problem, _REMEDY)
    return keypoint_table(columns, values, names, path)


class _Literals(pickle.Unpickler):
    """Reads lists, tuples, texts and numbers of a pickle. Any other object needs a class or a function: refused."""

    def find_class(self, module: str, name: str) -> None:
        """Raise ValueError, so that no class or function is called."""
        raise ValueError(f"its pickled names of columns call {module}.{name}, so that they are not read")


def _axis(table: Any, name: str) -> list[tuple[str, ...]]:
    """Return the names along an axis; an axis with several levels has codes into the texts of every level."""
    if hdf5_text(table.attrs.get(f"{name}_variety")) != "multi":
        return [(hdf5_text(value),) for value in table[name][()].tolist()]
    levels = []
    for i in range(int(table.attrs[f"{name}_nlevels"])):
        texts = [hdf5_text(value) for value in table[f"{name}_level{i}"][()].tolist()]
        levels.append(["" if code < 0 else texts[code] for code in table[f"{name}_label{i}"][()].tolist()])
    return list(zip(*levels, strict=True))
