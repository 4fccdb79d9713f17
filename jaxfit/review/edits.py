"""Edits of the tracks of observations: swap, cut, join, delete."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError

_CELLS = ("present", "keypoints_px", "confidence", "occluded", "score", "box_px")
_MAPPINGS = ("masks", "amodal_masks", "own_images")


class Edit(NamedTuple):
    """One correction."""

    kind: str
    """`swap`: two tracks exchange their birds. `cut`: the frames from `start` on become a new track. `join`: the second
    track becomes a part of the first track. `delete`: the tracks are removed."""
    tracks: tuple[int, ...]
    start: int | None = None
    """Number of the first frame of a swap or a cut; None swaps all frames."""
    stop: int | None = None
    """Number after the last frame of a swap; None is the end."""

    def __str__(self) -> str:
        tracks = ",".join(map(str, self.tracks))
        start = "" if self.start is None else str(self.start)
        stop = "" if self.stop is None else f":{self.stop}"
        return f"{self.kind} {tracks}@{start}{stop}" if start or stop else f"{self.kind} {tracks}"


def apply_edits(observations: Observations, edits: Sequence[Edit], source: object) -> Observations:
    """Return the observations after all edits, one after the other. A new track gets the next free number.

    Raises:
        InputError: a track or frame is not there, a track is named twice, joined tracks share a frame, or no track
            would be left.
    """
    for edit in edits:
        rows = [_row(observations, track, edit, source) for track in edit.tracks]
        if len(set(rows)) < len(rows):
            raise InputError(source, f"{edit}: names a track twice", "name different tracks")
        frames = _frames(observations, edit, source)
        if edit.kind == "swap":
            observations = _moved(observations, {rows[0]: rows[1], rows[1]: rows[0]}, frames)
        elif edit.kind == "cut":
            observations = _moved(_with_empty_track(observations), {rows[0]: observations.num_tracks}, frames)
        elif edit.kind == "join":
            both = np.flatnonzero(observations.present[rows[0]] & observations.present[rows[1]])
            if len(both):
                problem = f"{edit}: both tracks have a bird in frame {observations.frame_index[both[0]]}"
                raise InputError(source, problem, "cut a track, or delete the wrong part first")
            present = observations.present[rows[1]]
            observations = _moved(observations, {rows[1]: rows[0]}, present)
            observations = observations.select(tracks=np.arange(observations.num_tracks) != rows[1])
        else:
            observations = observations.select(tracks=~np.isin(np.arange(observations.num_tracks), rows))
        kept = observations.present.any(axis=1)
        observations = observations.select(tracks=kept)
    if not observations.num_tracks:
        raise InputError(source, "has no track left after the corrections", "delete fewer tracks")
    return observations


def _row(observations: Observations, track: int, edit: Edit, source: object) -> int:
    at = np.flatnonzero(observations.track_id == track)
    if not len(at):
        known = ", ".join(map(str, observations.track_id.tolist()[:20]))
        raise InputError(source, f"{edit}: there is no track {track}", f"its tracks are {known}")
    return int(at[0])


def _frames(observations: Observations, edit: Edit, source: object) -> np.ndarray:
    """Return which frames an edit changes, (T,) bool."""
    numbers = observations.frame_index
    first, last = int(numbers[0]), int(numbers[-1])
    start = first if edit.start is None else edit.start
    stop = last + 1 if edit.stop is None else edit.stop
    if not (first <= start <= last and start < stop <= last + 1):
        raise InputError(source, f"{edit}: there are no such frames", f"its frames are {first}:{last + 1}")
    return (numbers >= start) & (numbers < stop)


def _moved(observations: Observations, target: dict[int, int], frames: np.ndarray) -> Observations:
    """Return observations in which some rows have moved to other rows in some frames; what they leave is empty."""
    arrays: dict[str, Any] = {}
    for name in _CELLS:
        old = np.asarray(getattr(observations, name))
        new = old.copy()
        for row in target:
            new[row, frames] = 0
        for row, other in target.items():
            new[other, frames] = old[row, frames]
        arrays[name] = new
    for name in _MAPPINGS:
        mapping = getattr(observations, name)
        arrays[name] = {(target.get(n, n) if frames[t] else n, t): value for (n, t), value in mapping.items()}
    return replace(observations, **arrays)


def _with_empty_track(observations: Observations) -> Observations:
    """Return the observations with one more track, whose number is the next after the largest number."""
    arrays: dict[str, Any] = {}
    for name in _CELLS:
        values = np.asarray(getattr(observations, name))
        arrays[name] = np.concatenate([values, np.zeros_like(values[:1])])
    number = int(observations.track_id.max()) + 1
    return replace(observations, track_id=np.append(observations.track_id, number), **arrays)
