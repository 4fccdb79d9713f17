"""Edits of the tracks of observations (swap, cut, join, delete, exclude), and their form as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.observations import CELLS, MAPPINGS, Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_text

EXAMPLES = {"swap": "3,5@120:200", "cut": "4@80", "join": "2,7", "delete": "6", "exclude": "3@10:20"}
"""Kind of an edit → example of its tracks and frames."""
_TRACKS = {"swap": 2, "cut": 1, "join": 2, "delete": None, "exclude": 1}
"""Kind of an edit → number of its tracks; None is any number."""
_FORM = re.compile(r"([a-z]+) ([0-9]{1,18}(?:,[0-9]{1,18})*)(?:@(?=[0-9:])([0-9]{1,18})?(?::([0-9]{1,18}))?)?")
"""Kind, tracks, first frame and end of the frames."""


class Edit(NamedTuple):
    """One correction."""

    kind: str
    """`swap`: two tracks exchange their birds. `cut`: the frames from `start` on become a new track. `join`: the second
    track becomes a part of the first track. `delete`: the tracks are removed. `exclude`: the observations of a track
    are removed in some frames."""
    tracks: tuple[int, ...]
    start: int | None = None
    """Number of the first frame of a swap, a cut or an exclusion; None is the first frame of the observations."""
    stop: int | None = None
    """Number after the last frame of a swap or an exclusion; None is the end."""

    def __str__(self) -> str:
        """Return the edit as text, the form that `parse_edit` reads."""
        tracks = ",".join(map(str, self.tracks))
        start = "" if self.start is None else str(self.start)
        stop = "" if self.stop is None else f":{self.stop}"
        return f"{self.kind} {tracks}@{start}{stop}" if start or stop else f"{self.kind} {tracks}"


def parse_edit(text: str, source: object) -> Edit:
    """Return an edit from its form as text.

    Args:
        text: kind, tracks and frames, for example ``swap 3,5@120:200``, ``cut 4@80``, ``join 2,7``, ``delete 6`` or
            ``exclude 3@10:20``. Frames are numbers; the number after the colon is the end, which is not included.
            ``@120`` reaches to the end of the observations, ``@:200`` begins at their start. A swap without frames
            means all frames.
        source: the file or the option, for messages.

    Raises:
        InputError: the kind is unknown, the number of tracks is not that of the kind, a cut names no frame or an end,
            an exclusion names no frames, or a join or a deletion names frames.
    """
    match = _FORM.fullmatch(text)
    kind, named, *ends = match.groups() if match else (text.partition(" ")[0], "", None, None)
    numbers = tuple(int(part) for part in named.split(",") if part)
    start, stop = (None if end is None else int(end) for end in ends)
    wrong = not numbers or kind not in _TRACKS or (_TRACKS[kind] or len(numbers)) != len(numbers)
    wrong |= kind == "cut" and (start is None or stop is not None)
    wrong |= kind in ("join", "delete") and (start, stop) != (None, None)
    wrong |= kind == "exclude" and (start, stop) == (None, None)
    if wrong:
        examples = (
            [f"{kind} {EXAMPLES[kind]}"] if kind in EXAMPLES else [" ".join(example) for example in EXAMPLES.items()]
        )
        remedy = f"write for example {', '.join(examples)}"
        if kind == "exclude":
            remedy += "; delete removes all frames of a track"
        raise InputError(source, f"'{text}' is not a correction", remedy)
    return Edit(kind, numbers, start, stop)


def read_edits(path: str | Path) -> list[Edit]:
    """Read a text file with one edit a line, in the form of `parse_edit`.

    Empty lines, lines that begin with ``#``, and spaces at the ends of a line are ignored.

    Raises:
        InputError: the file cannot be read, is too large or is not UTF-8; or a line is not an edit. The message names
            the first such line.
    """
    edits = []
    for number, line in enumerate(read_text(path, "a text file of corrections").splitlines(), 1):
        text = line.strip()
        if text and not text.startswith("#"):
            try:
                edits.append(parse_edit(text, path))
            except InputError as error:
                raise InputError(path, f"line {number}: {error.problem}", error.remedy) from None
    return edits


def edits_text(edits: Sequence[Edit], before: str = "") -> str:
    """Return the content of a file of edits, which `read_edits` reads; one line per edit.

    Args:
        edits: the edits.
        before: the present content of the file. Its comments, empty lines and equal first edits stay as they are.

    Raises:
        InputError: an edit is not complete, such as a cut without a frame.
    """
    lines = [str(parse_edit(str(edit), "corrections")) for edit in edits]
    kept, equal = [], 0
    for line in before.splitlines():
        text = line.strip()
        if not text or text.startswith("#"):
            kept.append(line)
        elif lines[equal : equal + 1] == [text]:
            kept.append(line)
            equal += 1
        else:
            break
    rest = before.splitlines()[len(kept) :]
    kept += [line for line in rest if not line.strip() or line.strip().startswith("#")]
    return "".join(f"{line}\n" for line in [*kept, *lines[equal:]])


def apply_edits(observations: Observations, edits: Sequence[Edit], source: object) -> Observations:
    """Return the observations after all edits, one after the other.

    A new track gets the next free number. A track without a frame is removed. The frames stay, also those without a
    bird.

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
        elif edit.kind == "exclude":
            observations = _moved(observations, {rows[0]: None}, frames)
        else:
            observations = observations.select(tracks=~np.isin(np.arange(observations.num_tracks), rows))
        kept = observations.present.any(axis=1)
        observations = observations.select(tracks=kept)
    if not observations.num_tracks:
        raise InputError(source, "has no track left after the corrections", "delete or exclude less")
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


def _moved(observations: Observations, target: dict[int, int | None], frames: np.ndarray) -> Observations:
    """Return observations in which some rows have moved to other rows in some frames, or are removed there (None)."""
    arrays: dict[str, Any] = {}
    for name in CELLS:
        old = np.asarray(getattr(observations, name))
        new = old.copy()
        for row in target:
            new[row, frames] = 0
        for row, other in target.items():
            if other is not None:
                new[other, frames] = old[row, frames]
        arrays[name] = new
    for name in MAPPINGS:
        mapping = getattr(observations, name)
        places = (((target.get(n, n) if frames[t] else n), t, value) for (n, t), value in mapping.items())
        arrays[name] = {(n, t): value for n, t, value in places if n is not None}
    return replace(observations, **arrays)


def _with_empty_track(observations: Observations) -> Observations:
    """Return the observations with one more track, whose number is the next after the largest number."""
    arrays: dict[str, Any] = {}
    for name in CELLS:
        values = np.asarray(getattr(observations, name))
        arrays[name] = np.concatenate([values, np.zeros_like(values[:1])])
    number = int(observations.track_id.max()) + 1
    return replace(observations, track_id=np.append(observations.track_id, number), **arrays)
