"""Edits of observations as text: of tracks (swap, cut, join, delete, exclude), and of keypoints (`points`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.observations import CELLS, MAPPINGS, Observations
from jaxfit.foundation.array_files import check_memory, observations_bytes
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_text
from jaxfit.review.points import POINT_EXAMPLES, Point, parse_point, with_points

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


def parse_edit(text: str, source: object) -> Edit | Point:
    """Return an edit from its form as text.

    Args:
        text: kind, tracks and frames, for example ``swap 3,5@120:200``, ``cut 4@80``, ``join 2,7``, ``delete 6`` or
            ``exclude 3@10:20``. Frames are numbers; the number after the colon is the end, which is not included.
            ``@120`` reaches to the end of the observations, ``@:200`` begins at their start. A swap without frames
            means all frames. Keypoints have the form of `parse_point`.
        source: the file or the option, for messages.

    Raises:
        InputError: the kind is unknown, the number of tracks is not that of the kind, a cut names no frame or an end,
            an exclusion names no frames, or a join or a deletion names frames.
    """
    if text.partition(" ")[0] in POINT_EXAMPLES:
        return parse_point(text, source)
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


def read_edits(path: str | Path) -> list[Edit | Point]:
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


def edits_text(edits: Sequence[Edit | Point], before: str = "") -> str:
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


def apply_edits(
    observations: Observations, edits: Sequence[Edit | Point], source: object, only_labels: bool = False
) -> Observations:
    """Return the observations after all edits: first those of keypoints, then those of tracks, one after the other.

    So a keypoint names its bird as the result does, and not as an earlier edit of tracks does. With `only_labels`, all
    keypoints are removed that no person has placed or accepted.

    A new track gets the next free number. A track without a frame is removed. The frames stay, also those without a
    bird. The arrays are moved once, after the last edit, so the time is linear in the number of edits.

    Raises:
        InputError: a track or frame is not there, a track is named twice, joined tracks share a frame, the tracks need
            too much memory, or no track would be left.
    """
    points = [edit for edit in edits if isinstance(edit, Point)]
    if points or only_labels:
        observations, labelled = with_points(observations, points, source)
        if only_labels:
            observations = observations.with_keypoints(
                np.where(labelled[..., None], observations.keypoints_px, 0), labelled.astype(np.float32)
            )
    edits = [edit for edit in edits if not isinstance(edit, Point)]
    N, T, K = observations.confidence.shape
    numbers = observations.frame_index
    first, last = int(numbers[0]), int(numbers[-1])
    rows_of = np.where(observations.present, np.arange(N)[:, None], -1)
    origin = {int(track): row for track, row in zip(observations.track_id, rows_of, strict=True) if (row >= 0).any()}
    """Track → row of the observations that the track has in every frame (T,); −1 without a bird."""
    largest = max(origin, default=0)
    for edit in edits if origin else ():
        for track in edit.tracks:
            if track not in origin:
                known = ", ".join(map(str, list(origin)[:20]))
                raise InputError(source, f"{edit}: there is no track {track}", f"its tracks are {known}")
        if len(set(edit.tracks)) < len(edit.tracks):
            raise InputError(source, f"{edit}: names a track twice", "name different tracks")
        start = first if edit.start is None else edit.start
        stop = last + 1 if edit.stop is None else edit.stop
        if not (first <= start <= last and start < stop <= last + 1):
            raise InputError(source, f"{edit}: there are no such frames", f"its frames are {first}:{last + 1}")
        frames, rows = (
            slice(*np.searchsorted(numbers, (start, stop)).tolist()),
            [origin[track] for track in edit.tracks],
        )
        if edit.kind == "swap":
            rows[0][frames], rows[1][frames] = rows[1][frames].copy(), rows[0][frames].copy()
        elif edit.kind == "join":
            both = np.flatnonzero((rows[0] >= 0) & (rows[1] >= 0))
            if len(both):
                problem = f"{edit}: both tracks have a bird in frame {numbers[both[0]]}"
                raise InputError(source, problem, "cut a track, or delete the wrong part first")
            np.maximum(rows[0], rows[1], out=rows[0])
            rows[1][:] = -1
        elif edit.kind == "delete":
            for row in rows:
                row[:] = -1
        else:  # a cut or an exclusion
            if edit.kind == "cut" and (rows[0][frames] >= 0).any():
                largest += 1
                origin[largest] = np.full(T, -1)
                origin[largest][frames] = rows[0][frames]
                needed = observations_bytes(len(origin), T, K)
                check_memory(source, f"{len(origin):,} tracks over {T:,} frames", needed, "cut less")
            rows[0][frames] = -1
        for track in [track for track in edit.tracks if (origin[track] < 0).all()]:
            del origin[track]
            if track == largest:
                largest = max(origin, default=0)
    if not origin:
        raise InputError(source, "has no track left after the corrections", "delete or exclude less")
    return _with_tracks(observations, origin) if edits else observations


def _with_tracks(observations: Observations, origin: dict[int, np.ndarray]) -> Observations:
    """Return observations whose tracks have the birds of the rows `origin` (T,); −1 without a bird."""
    rows = np.stack(list(origin.values()))
    kept = rows >= 0
    columns = np.arange(rows.shape[1])
    target = np.full(observations.present.shape, -1)
    target[rows[kept], np.broadcast_to(columns, rows.shape)[kept]] = np.nonzero(kept)[0]
    arrays: dict[str, Any] = {}
    for name in CELLS:
        values = np.asarray(getattr(observations, name))[rows, columns]
        values[~kept] = 0
        arrays[name] = values
    for name in MAPPINGS:
        places = ((int(target[n, t]), t, value) for (n, t), value in getattr(observations, name).items())
        arrays[name] = {(n, t): value for n, t, value in places if n >= 0}
    return replace(observations, track_id=np.array(list(origin)), **arrays)
