"""Observations and results of several ranges of frames in one: frames follow each other, tracks are mapped to rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT, Solution

__all__ = ["concatenate_observations", "concatenate_solutions"]

_CELLS = ("present", "keypoints_px", "confidence", "occluded", "score", "box_px")
_FRAMES = ("frame_index", "image_size_px", "file_name", "timestamp_s")
_MAPPINGS = ("masks", "amodal_masks", "own_images")
_TIMES = ("frame_index", "timestamp_s")


def concatenate_observations(
    parts: Sequence[Observations], rows: Sequence[Int[np.ndarray, "n"]], track_id: Int[np.ndarray, "N"]
) -> Observations:
    """Return the observations of all frames.

    Args:
        parts: observations of ranges of frames, in the order of the frames.
        rows: for each part, the row of each of its tracks in the result.
        track_id: ids of the rows.
    """
    frames = np.cumsum([0, *(part.num_frames for part in parts)])
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _FRAMES}
    arrays |= {name: _cells(name, parts, rows, len(track_id)) for name in _CELLS}
    for name in _MAPPINGS:
        arrays[name] = {
            (int(row[n]), int(first) + t): value
            for part, row, first in zip(parts, rows, frames, strict=False)
            for (n, t), value in getattr(part, name).items()
        }
    return replace(parts[0], track_id=track_id, **arrays)


def concatenate_solutions(
    parts: Sequence[Solution], rows: Sequence[Int[np.ndarray, "n"]], track_id: Int[np.ndarray, "N"]
) -> Solution:
    """Return the poses of all frames; arguments as of `concatenate_observations`.

    The status of a track is `ok` if the track has this status in all parts, and the losses of its parts are summed.
    """
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _TIMES}
    for name, (shape, _) in LAYOUT.items():
        if shape.startswith("N T"):
            arrays[name] = _cells(name, parts, rows, len(track_id))
    loss = {term: np.full(len(track_id), np.nan) for term in dict.fromkeys(t for part in parts for t in part.loss)}
    statuses: list[list[str]] = [[] for _ in track_id]
    failures: dict[int, tuple[str, ...]] = {}
    for part, row in zip(parts, rows, strict=True):
        for n, own in enumerate(row.tolist()):
            statuses[own].append(str(part.status[n]))
            texts = part.failures.get(int(part.track_id[n]), ())
            if texts:
                failures[int(track_id[own])] = (*failures.get(int(track_id[own]), ()), *texts)
            for term, values in part.loss.items():
                if np.isfinite(values[n]):
                    loss[term][own] = np.nansum([loss[term][own], values[n]])
    status = np.array([_status(each) for each in statuses], "<U32")
    return replace(parts[0], track_id=track_id, **arrays, loss=loss, status=status, failures=failures)


def _cells(name: str, parts: Sequence[Any], rows: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Return an array (N, T, …) of all tracks and frames; NaN, 0 or False where a part lacks a track."""
    pieces = []
    for part, row in zip(parts, rows, strict=True):
        values = getattr(part, name)
        absent = np.nan if isinstance(part, Solution) and values.dtype.kind == "f" else 0
        piece = np.full((count, *values.shape[1:]), absent, values.dtype)
        piece[row] = values
        pieces.append(piece)
    return np.concatenate(pieces, axis=1)


def _status(parts: Sequence[str]) -> str:
    """Return the status of a track from its statuses in all parts with the track."""
    fitted = [status for status in parts if status != "no usable frame"]
    if not fitted:
        return "no usable frame"
    return fitted[0] if len(set(fitted)) == 1 else "partly diverged"
