"""Columns of DeepLabCut: from labelled columns of numbers to a table of keypoints.

A column has the levels scorer, individuals (only for several animals), bodyparts and coords. Every individual becomes a
bird. The individual `single`, which holds the keypoints of the scene, is skipped. Coords other than x, y and likelihood
are skipped too, such as the variances that Lightning Pose writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.errors import InputError
from jaxfit.limits import FRAME_DIGITS

__all__ = ["COORDS", "keypoint_table", "row_names"]

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
