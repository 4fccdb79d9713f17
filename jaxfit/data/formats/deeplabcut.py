"""Files of DeepLabCut and Lightning Pose: CSV and HDF5, without unpickling.

Columns of DeepLabCut: from labelled columns of numbers to a table of keypoints. A column has the levels scorer,
individuals (only for several animals), bodyparts and coords. Every individual becomes a bird. The individual `single`,
which holds the keypoints of the scene, is skipped. Coords other than x, y and likelihood are skipped too, such as the
variances that Lightning Pose writes.

CSV files of DeepLabCut and of Lightning Pose, which have the same layout: predictions and labels. The file begins with
one line for every level of the columns: scorer, individuals (only for several animals), bodyparts, coords. The first
cell of the other lines is a frame number (predictions) or the name of a picture (labels). Newer labels have three such
cells: `labeled-data`, the folder, the picture. An empty cell is a missing keypoint.

Lists, tuples and names in pickled attributes, read without unpickling. pandas stores the names of columns as pickles in
the attributes of an HDF5 file. A pickle is a program that can call any function. `pickletools` lists its instructions
without running them, and this module follows only the instructions that build lists, tuples, texts and numbers.

The files are tables of pandas, stored by PyTables in two layouts. In the layout `table`, one compound array holds the
rows, and pickled attributes hold the names of the columns. In the layout `fixed`, arrays hold the values, and further
arrays hold the names. No attribute is unpickled: `pickled_literals` reads the names.
"""

from __future__ import annotations

import csv
import io
import pickletools
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.formats.hdf5 import Hdf5Group
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import FRAME_DIGITS, HDF5_TEXT_BYTES, TABLE_VALUES
from jaxfit.foundation.reading import read_file

COORDS = ("x", "y", "likelihood")
"""The last levels of the columns that are read."""
_SCENE = "single"


def keypoint_table(
    columns: Sequence[tuple[str, ...]],
    values: np.ndarray,
    source: Path,
    frame_index: np.ndarray | None,
    pictures: tuple[str, ...] | None,
) -> KeypointTable:
    """Return the table of keypoints of labelled columns.

    Args:
        columns: the 3 or 4 levels of every column.
        values: (T, columns) numbers.
        source: the file, for messages.
        frame_index: frame number of every row, or None.
        pictures: name of the picture of every row, or None.

    Raises:
        InputError: no column of positions, a column twice, or a keypoint without x or y.
    """
    scorers: dict[str, None] = {}
    place: dict[tuple[str, str, str], int] = {}
    for i, levels in enumerate(columns):
        scorer, bird, keypoint, coord = levels if len(levels) == 4 else (levels[0], "", *levels[1:])
        if coord not in COORDS or (bird == _SCENE and len(levels) == 4):
            continue
        scorers[scorer] = None
        if (bird, keypoint, coord) in place:
            other = " of a second scorer" if len(scorers) > 1 else ""
            problem = f"holds the column {coord} of {keypoint} twice{f' for {bird}' if bird else ''}{other}"
            raise InputError(source, problem, "keep one column")
        place[bird, keypoint, coord] = i
    birds = tuple(dict.fromkeys(bird for bird, _, _ in place))
    names = tuple(dict.fromkeys(keypoint for _, keypoint, _ in place))
    if not place:
        coords = ", ".join(dict.fromkeys(levels[-1] for levels in columns))
        raise InputError(source, f"has no columns x and y of a bird, only {coords or 'none'}", "give poses or labels")
    check_table_size(source, len(birds), len(values), len(names))
    keypoints = np.full((len(birds), len(values), len(names), 2), np.nan, np.float32)
    certain = not any(coord == "likelihood" for _, _, coord in place)
    confidence = None if certain else np.ones(keypoints.shape[:-1], np.float32)
    row, column = ({name: i for i, name in enumerate(group)} for group in (birds, names))
    with np.errstate(over="ignore"):
        for (bird, keypoint, coord), i in place.items():
            for needed in ("x", "y"):
                if (bird, keypoint, needed) not in place:
                    problem = f"has no column {needed} of {keypoint}"
                    raise InputError(source, problem, "every keypoint needs the columns x and y")
            if coord == "likelihood":
                confidence[row[bird], :, column[keypoint]] = values[:, i]  # type: ignore[index]
            else:
                keypoints[row[bird], :, column[keypoint], COORDS.index(coord)] = values[:, i]
    return KeypointTable(names, tuple(b or "bird" for b in birds), keypoints, confidence, frame_index, pictures)


def row_names(names: Sequence[str], source: Path) -> tuple[np.ndarray | None, tuple[str, ...] | None]:
    """Return the frame numbers of rows with numbers as names, or the names of pictures; the other is None.

    Raises:
        InputError: no row, or rows of both kinds.
    """
    if not names:
        raise InputError(source, "holds no frames", "choose another file")
    numbered = [name.isascii() and name.isdecimal() and len(name) <= FRAME_DIGITS for name in names]
    if all(numbered):
        return np.array([int(name) for name in names], np.int64), None
    if any(numbered):
        problem = f"names its row {numbered.index(True) + 1} by a number, and row {numbered.index(False) + 1} otherwise"
        raise InputError(source, problem, "name all rows by frame numbers or by pictures")
    return None, tuple(names)


_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_CSV_REMEDY = "give the .csv that DeepLabCut or Lightning Pose writes"


def read_deeplabcut_csv(path: Path) -> KeypointTable:
    """Read a CSV file of DeepLabCut or Lightning Pose.

    Raises:
        InputError: the file cannot be read, a header row is missing, or a cell is not a number.
    """
    lines = _lines(path, read_file(path, "a CSV file"))
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
        raise InputError(path, f"is not valid CSV: {error}", _CSV_REMEDY) from error


def _check_header(path: Path, header: Sequence[list[str]], first: tuple[int, list[str]] | None) -> None:
    levels = tuple(cells[0].strip().lower() for cells in header)
    if levels not in (_LEVELS, (_LEVELS[0], *_LEVELS[2:])):
        if "scorer" not in levels:
            begins = (header[0] if header else first[1] if first else [""])[0][:40]
            raise InputError(path, f"has no scorer row: its first line begins with {begins!r}", _CSV_REMEDY)
        problem = f"begins with the rows {', '.join(levels)}, not with scorer, (individuals,) bodyparts, coords"
        raise InputError(path, problem, _CSV_REMEDY)
    if len({len(cells) for cells in header}) > 1:
        counts = ", ".join(str(len(cells)) for cells in header)
        raise InputError(path, f"has header rows of {counts} cells, which must be equal", _CSV_REMEDY)


def _number(path: Path, line: int, cell: str, column: tuple[str, ...]) -> float:
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        problem = f"line {line} holds {cell[:40]!r} for {' '.join(column[1:])}"
        raise InputError(path, problem, "write a number, or leave the cell empty") from None


_VALUES = {
    *("INT", "LONG", "LONG1", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING"),
}
"""Instructions whose argument is the value."""
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_IGNORED = {"PROTO", "FRAME"}
_MARK = object()


class NotLiteralError(ValueError):
    """The pickle holds more than lists, tuples, texts and numbers, or is damaged."""


def read_literal(content: bytes) -> Any:
    """Return the lists, tuples, texts and numbers of a pickle.

    Raises:
        NotLiteralError: the pickle is damaged, or holds anything else, such as an object or a call of a function.
    """
    if len(content) > HDF5_TEXT_BYTES:
        raise NotLiteralError(f"has {len(content):,} bytes")
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    try:
        for code, argument, _ in pickletools.genops(content):
            if code.name == "STOP":
                (value,) = stack
                return value
            _follow(code.name, argument, stack, memo)
    except NotLiteralError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, MemoryError) as error:
        raise NotLiteralError("is damaged") from error
    raise NotLiteralError("is damaged")


def _follow(name: str, argument: Any, stack: list[Any], memo: dict[int, Any]) -> None:
    """Follow one instruction."""
    if name in _VALUES:
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name == "MARK":
        stack.append(_MARK)
    elif name in ("EMPTY_LIST", "EMPTY_TUPLE"):
        stack.append([] if name == "EMPTY_LIST" else ())
    elif name in ("LIST", "TUPLE"):
        items = _since_mark(stack)
        stack.append(items if name == "LIST" else tuple(items))
    elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
        count = int(name[-1])
        items = tuple(stack[-count:])
        if len(items) < count or any(item is _MARK for item in items):
            raise ValueError(name)
        stack[-count:] = [items]
    elif name in ("APPEND", "APPENDS"):
        items = [stack.pop()] if name == "APPEND" else _since_mark(stack)
        if not isinstance(stack[-1], list) or any(item is stack[-1] for item in items):
            raise ValueError(name)
        stack[-1].extend(items)
    elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
        memo[argument] = stack[-1]
    elif name == "MEMOIZE":
        memo[len(memo)] = stack[-1]
    elif name in ("GET", "BINGET", "LONG_BINGET"):
        stack.append(memo[argument])
    elif name not in _IGNORED:
        raise NotLiteralError(f"holds the instruction {name}")


def _since_mark(stack: list[Any]) -> list[Any]:
    """Remove and return the values above the last mark."""
    for i in range(len(stack) - 1, -1, -1):
        if stack[i] is _MARK:
            items = stack[i + 1 :]
            del stack[i:]
            return items
    raise ValueError("no mark")


_HDF5_REMEDY = "give the .h5 that DeepLabCut writes, or its .csv"
_LAYOUTS = {b"frame_table": "table", b"frame": "fixed"}
_MAX_BLOCKS = 100
_MAX_LEVELS = 4


def find_pandas_table(root: Hdf5Group) -> Hdf5Group | None:
    """Return the first folder of an HDF5 file that holds a table of pandas, or None."""
    for name in root.names():
        if root.is_group(name) and root.group(name).attribute("pandas_type") in _LAYOUTS:
            return root.group(name)
    return None


def read_deeplabcut_hdf5(table: Hdf5Group, path: Path) -> KeypointTable:
    """Read the table of an HDF5 file of DeepLabCut.

    Args:
        table: the folder of the table, as `find_pandas_table` returns it.
        path: the file, for messages.

    Raises:
        InputError: the table is damaged or holds no poses.
    """
    layout = _LAYOUTS[table.attribute("pandas_type")]  # type: ignore[index]
    columns, values, names = (_read_table if layout == "table" else _read_fixed)(table)
    for levels in columns:
        if len(levels) not in (3, 4):
            problem = f"has columns of {len(levels)} levels, not of scorer, (individuals,) bodyparts, coords"
            raise InputError(path, problem, _HDF5_REMEDY)
    if len({len(levels) for levels in columns}) > 1:
        raise InputError(path, "has columns of different numbers of levels", _HDF5_REMEDY)
    return keypoint_table(columns, values, path, *row_names(names, path))


def _read_table(table: Hdf5Group) -> tuple[list[tuple[str, ...]], np.ndarray, list[str]]:
    """Return columns, values and names of the rows of the layout `table`."""
    types = table.column_types("table")
    blocks = sorted(name for name in types if name.startswith("values_block_"))[:_MAX_BLOCKS]
    read = table.columns("table", {"index": "iuS", **dict.fromkeys(blocks, "iuf")}, ndim=None)
    columns: list[tuple[str, ...]] = []
    values = [np.zeros((len(read["index"]), 0))]
    for name in blocks:
        block = read[name].reshape(len(read["index"]), -1)
        names = _pickled_names(table, f"{name}_kind")
        if len(names) != block.shape[1]:
            table.fail("table", f"has {block.shape[1]} columns in {name}, but {len(names)} names")
        columns += names
        values.append(block.astype(np.float64))
    return columns, np.concatenate(values, axis=1), _row_texts(table, "table", read["index"])


def _pickled_names(table: Hdf5Group, name: str) -> list[tuple[str, ...]]:
    content = table.attribute(name, "table")
    try:
        value: Any = read_literal(content if isinstance(content, bytes) else b"")
    except NotLiteralError as error:
        table.fail(f"attribute {name}", f"{error}, so that it is not read", "write the file again, or give the .csv")
    valid = isinstance(value, list) and all(isinstance(levels, tuple) for levels in value)
    if not valid or not all(isinstance(level, str) for levels in value for level in levels):
        table.fail(f"attribute {name}", "does not hold the names of columns", _HDF5_REMEDY)
    return value


def _read_fixed(table: Hdf5Group) -> tuple[list[tuple[str, ...]], np.ndarray, list[str]]:
    """Return columns, values and names of the rows of the layout `fixed`."""
    rows = ["/".join(levels) for levels in _axis(table, "axis1")]
    blocks = _count(table, "nblocks", _MAX_BLOCKS)
    columns: list[tuple[str, ...]] = []
    values = [np.zeros((len(rows), 0))]
    for b in range(blocks):
        block = table.array(f"block{b}_values", "iuf", 2)
        names = _axis(table, f"block{b}_items")
        if block.shape != (len(rows), len(names)):
            problem = f"is {block.shape[0]}×{block.shape[1]}, but has {len(rows)} rows and {len(names)} columns"
            table.fail(f"block{b}_values", problem)
        columns += names
        values.append(block.astype(np.float64))
    return columns, np.concatenate(values, axis=1), rows


def _axis(table: Hdf5Group, name: str) -> list[tuple[str, ...]]:
    """Return the names along an axis; an axis with several levels has codes into the texts of every level."""
    if table.attribute(f"{name}_variety") != b"multi":
        return [(text,) for text in _row_texts(table, name, table.array(name, "iuS", 1))]
    levels = []
    for i in range(_count(table, f"{name}_nlevels", _MAX_LEVELS)):
        texts = _row_texts(table, f"{name}_level{i}", table.array(f"{name}_level{i}", "iuS", 1))
        codes = table.array(f"{name}_label{i}", "iu", 1).astype(np.int64)
        if len(codes) and not (codes.min() >= -1 and codes.max() < len(texts)):
            table.fail(f"{name}_label{i}", f"holds a code outside its {len(texts)} texts")
        levels.append(["" if code < 0 else texts[code] for code in codes.tolist()])
    if len({len(texts) for texts in levels}) > 1:
        table.fail(name, "has levels of different lengths")
    return list(zip(*levels, strict=True))


def _row_texts(table: Hdf5Group, name: str, values: np.ndarray) -> list[str]:
    if values.ndim != 1:
        table.fail(name, f"has names with {values.ndim} axes, not 1")
    if values.dtype.kind == "S":
        try:
            return [value.decode("utf-8") for value in values.tolist()]
        except UnicodeDecodeError:
            table.fail(name, "holds text that is not UTF-8")
    return [str(value) for value in values.tolist()]


def _count(table: Hdf5Group, attribute: str, most: int) -> int:
    value = table.attribute(attribute)
    if not isinstance(value, float) or not 0 <= value <= most or value != int(value):
        table.fail(f"attribute {attribute}", f"is {value!r}, not a number from 0 to {most}")
    return int(value)
