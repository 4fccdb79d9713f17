"""HDF5 files of DeepLabCut: predictions and labels, of one and of several animals.

The files are tables of pandas, stored by PyTables in two layouts. In the layout `table`, one compound array holds the
rows, and pickled attributes hold the names of the columns. In the layout `fixed`, arrays hold the values, and further
arrays hold the names. No attribute is unpickled: `pickled_literals` reads the names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.formats.deeplabcut.columns import keypoint_table, row_names
from jaxfit.data.formats.deeplabcut.pickled_literals import NotLiteralError, read_literal
from jaxfit.data.formats.hdf5 import Hdf5Group
from jaxfit.data.formats.keypoint_table import KeypointTable
from jaxfit.errors import InputError

__all__ = ["find_pandas_table", "read_deeplabcut_hdf5"]

_REMEDY = "give the .h5 that DeepLabCut writes, or its .csv"
_LAYOUTS = {b"frame_table": "table", b"frame": "fixed"}
_MOST_BLOCKS = 100
_MOST_LEVELS = 4


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
            raise InputError(path, problem, _REMEDY)
    if len({len(levels) for levels in columns}) > 1:
        raise InputError(path, "has columns of different numbers of levels", _REMEDY)
    return keypoint_table(columns, values, path, *row_names(names, path))


def _read_table(table: Hdf5Group) -> tuple[list[tuple[str, ...]], np.ndarray, list[str]]:
    """Return columns, values and names of the rows of the layout `table`."""
    types = table.column_types("table")
    blocks = sorted(name for name in types if name.startswith("values_block_"))[:_MOST_BLOCKS]
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
        table.fail(f"attribute {name}", "does not hold the names of columns", _REMEDY)
    return value


def _read_fixed(table: Hdf5Group) -> tuple[list[tuple[str, ...]], np.ndarray, list[str]]:
    """Return columns, values and names of the rows of the layout `fixed`."""
    rows = ["/".join(levels) for levels in _axis(table, "axis1")]
    blocks = _count(table, "nblocks", _MOST_BLOCKS)
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
    for i in range(_count(table, f"{name}_nlevels", _MOST_LEVELS)):
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
