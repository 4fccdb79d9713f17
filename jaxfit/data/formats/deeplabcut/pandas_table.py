"""Tables of DeepLabCut as HDF5, written without pickles.

Source: the layout is that of `DataFrame.to_hdf` of pandas 3 (`format="fixed"`), which DeepLabCut reads.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.extras import require_extra
from jaxfit.storage.files import write_whole

__all__ = ["COLUMN_LEVELS", "write_pandas_table"]

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
