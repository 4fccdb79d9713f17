"""Some tracks and frames of a solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from jaxfit.data.solution import LAYOUT, Solution
from jaxfit.errors import InputError

__all__ = ["frame_positions", "select_solution", "track_positions"]


def select_solution(solution: Solution, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"]) -> Solution:
    """Return M tracks and L frames of a solution, chosen by their positions.

    The loss of a track stays the loss over all its frames.
    """
    arrays = {}
    for name, (shape, _) in LAYOUT.items():
        if shape.split()[0] not in ("N", "T"):
            continue
        array = getattr(solution, name)
        if shape.startswith("N"):
            array = array[rows]
        if "T" in shape.split():
            array = array.take(columns, axis=shape.split().index("T"))
        arrays[name] = array
    kept = set(arrays["track_id"].tolist())
    return replace(
        solution,
        **arrays,
        loss={term: values[rows] for term, values in solution.loss.items()},
        failures={track: texts for track, texts in solution.failures.items() if track in kept},
        timestamp_s=None if solution.timestamp_s is None else solution.timestamp_s[columns],
    )


def track_positions(solution: Solution, tracks: Sequence[int] | None, source: object) -> Int[np.ndarray, "M"]:
    """Return the positions of some tracks, in the order of the solution; None means all tracks.

    Raises:
        InputError: the solution lacks a track, or no track is named.
    """
    known = solution.track_id.tolist()
    if tracks is None:
        return np.arange(len(known))
    missing = [track for track in tracks if track not in known]
    if missing or not tracks:
        problem = f"has no track {missing[0]}" if missing else "needs at least one track"
        raise InputError(source, problem, f"its tracks are {_listed(known)}")
    return np.flatnonzero(np.isin(solution.track_id, list(tracks)))


def frame_positions(solution: Solution, frames: tuple[int | None, int | None], source: object) -> Int[np.ndarray, "L"]:
    """Return the positions of the frames from a first frame to a last frame, which is left out, as in Python.

    Args:
        solution: the solution.
        frames: number of the first frame and number after the last frame; None is the first or the last frame of the
            solution.
        source: the result, for messages.

    Raises:
        InputError: the solution has no frames, or lacks a frame at one end of the range.
    """
    numbers = solution.frame_index
    if not len(numbers):
        raise InputError(source, "has no frames", "give another result")
    first, last = int(numbers[0]), int(numbers[-1])
    start, stop = (first if frames[0] is None else frames[0]), (last + 1 if frames[1] is None else frames[1])
    chosen = np.flatnonzero((numbers >= start) & (numbers < stop))
    if start < first or stop > last + 1 or not len(chosen):
        raise InputError(source, f"lacks the frames {start}:{stop}", f"its frames are {first}:{last + 1}")
    return chosen


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:20]))
    return f"{shown}, …" if len(numbers) > 20 else shown or "none"
