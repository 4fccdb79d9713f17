"""CSV files of DeepLabCut and of Lightning Pose, which have the same layout: predictions and labels.

The file begins with one line for every level of the columns: scorer, individuals (only for several animals), bodyparts,
coords. The first cell of the other lines is a frame number (predictions) or the name of a picture (labels). Newer
labels have three such cells: `labeled-data`, the folder, the picture. An empty cell is a missing keypoint.
"""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.formats.deeplabcut.columns import COORDS, keypoint_table, row_names
from jaxfit.data.formats.keypoint_table import KeypointTable
from jaxfit.errors import InputError
from jaxfit.limits import CSV_BYTES, TABLE_VALUES
from jaxfit.storage.reading import read_file

__all__ = ["read_deeplabcut_csv"]

_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_REMEDY = "give the .csv that DeepLabCut or Lightning Pose writes"


def read_deeplabcut_csv(path: Path) -> KeypointTable:
    """Read a CSV file of DeepLabCut or Lightning Pose.

    Raises:
        InputError: the file cannot be read, a header row is missing, or a cell is not a number.
    """
    lines = _lines(path, read_file(path, CSV_BYTES, "a CSV file"))
    header: list[list[str]] = []
    first: tuple[int, list[str]] | None = None
    for number, cells in lines:
        if len(header) == len(_LEVELS) or cells[0].strip().lower() not in _LEVELS:
            first = number, cells
            break
        header.append(cells)
    _check_header(path, header, first)
    # the cells of the header are empty above the names of the rows
    named = next((i for i, cell in enumerate(header[-1][1:], 1) if cell.strip()), len(header[-1]))
    columns = [tuple(cell.strip() for cell in column) for column in zip(*header, strict=True)]
    used = [i for i in range(named, len(columns)) if columns[i][-1] in COORDS]
    names: list[str] = []
    numbers = array("d")  # takes less memory than a list
    for number, cells in [first, *lines] if first else ():
        if len(cells) != len(columns):
            problem = f"line {number} has {len(cells)} cells, not {len(columns)}"
            raise InputError(path, problem, "the file may end midway: copy or write it again")
        if not (names or any(cells[named:]) or cells[0].isdecimal() or "." in cells[named - 1]):
            continue  # names of the index, which some programs write
        names.append("/".join(cell.strip() for cell in cells[:named] if cell.strip()))
        numbers.extend(_number(path, number, cells[i], columns[i]) for i in used)
        if len(numbers) > len(COORDS) * TABLE_VALUES:
            raise InputError(path, f"holds more than {len(numbers):,} numbers", "split the file")
    values = np.array(numbers, np.float64).reshape(len(names), len(used))
    return keypoint_table([columns[i] for i in used], values, path, *row_names(names, path))


def _lines(path: Path, content: bytes) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of every line that is not empty."""
    try:
        reader = csv.reader(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline=""), strict=True)
        for cells in reader:
            if any(cells):
                yield reader.line_num, cells
    except UnicodeDecodeError as error:
        raise InputError(path, "is not UTF-8 text", "give a CSV file, saved as UTF-8") from error
    except csv.Error as error:
        raise InputError(path, f"is not valid CSV: {error}", _REMEDY) from error


def _check_header(path: Path, header: Sequence[list[str]], first: tuple[int, list[str]] | None) -> None:
    levels = tuple(cells[0].strip().lower() for cells in header)
    if levels not in (_LEVELS, (_LEVELS[0], *_LEVELS[2:])):
        if "scorer" not in levels:
            begins = (header[0] if header else first[1] if first else [""])[0][:40]
            raise InputError(path, f"has no scorer row: its first line begins with {begins!r}", _REMEDY)
        problem = f"begins with the rows {', '.join(levels)}, not with scorer, (individuals,) bodyparts, coords"
        raise InputError(path, problem, _REMEDY)
    if len({len(cells) for cells in header}) > 1:
        counts = ", ".join(str(len(cells)) for cells in header)
        raise InputError(path, f"has header rows of {counts} cells, which must be equal", _REMEDY)


def _number(path: Path, line: int, cell: str, column: tuple[str, ...]) -> float:
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        problem = f"line {line} holds {cell[:40]!r} for {' '.join(column[1:])}"
        raise InputError(path, problem, "write a number, or leave the cell empty") from None
