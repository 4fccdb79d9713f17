"""Commands that list, correct and join the tracks of results."""

from __future__ import annotations

import argparse
import re

import numpy as np

from jaxfit.cli.tables import counted, right_aligned, show, track_table
from jaxfit.corrections.edits import Edit
from jaxfit.errors import InputError
from jaxfit.progress import terminal

__all__ = ["join", "tracks"]

_TRACKS = {"swap": 2, "cut": 1, "join": 2, "delete": None}
"""Kind of an edit → number of its tracks; None is any number."""


def tracks(options: argparse.Namespace) -> None:
    """List the tracks of a result, or correct the tracks and fit what changes."""
    if not options.edits:
        if options.out is not None:
            raise InputError("tracks", "has --out, but no correction", "give --swap, --cut, --join or --delete")
        _list(options)
        return
    if options.out is None:
        raise InputError("tracks", "has corrections, but no folder for the new result", "give --out")
    from jaxfit.corrections.correct import correct_tracks

    edits = [_edit(kind, text) for kind, text in options.edits]
    done = correct_tracks(
        options.result, options.out, edits, options.observations, options.overwrite, progress=terminal
    )
    for track, first, last in done.fitted:
        show(f"fitted again: track {track}, frames {first} to {last}")
    show(f"{len(done.fitted)} of {counted(done.windows, 'window')} fitted again → {options.out}")
    show(f"jaxfit overlay {options.out} --video VIDEO --out overlay.mp4 draws the new result")


def join(options: argparse.Namespace) -> None:
    """Join the results of ranges of one video."""
    from jaxfit.corrections.join import join_results

    solution, table = join_results(options.results, options.out, options.bridge, options.overwrite)
    shown = right_aligned("track", "first frame", "last frame", "becomes", "frames missing", "confidence")
    shown.add_column("of", overflow="fold")
    for row in table:
        continued = ("–", "–") if row.confidence is None else (str(row.missing), f"{row.confidence:.3f}")
        shown.add_row(
            str(row.track), str(row.first_frame), str(row.last_frame), str(row.joined), *continued, row.folder
        )
    shown.title = "confidence: that the track continues a track of an earlier range"
    show(shown)
    tracks, frames = counted(len(solution.track_id), "track"), counted(len(solution.frame_index), "frame")
    show(f"{tracks} over {frames} → {options.out}")


def _list(options: argparse.Namespace) -> None:
    from jaxfit.data.formats.coco import read_coco
    from jaxfit.data.solution import load_solution

    solution, _ = load_solution(options.result)
    table = right_aligned("track", "poses", "first frame", "last frame", "gaps")
    table.add_column("status")
    for n, track in enumerate(solution.track_id.tolist()):
        at = np.flatnonzero(solution.valid[n])
        gaps = int((np.diff(at) > 1).sum())
        ends = [str(solution.frame_index[at[i]]) if len(at) else "–" for i in (0, -1)]
        table.add_row(str(track), str(len(at)), *ends, str(gaps), str(solution.status[n]))
    show(table)
    path = options.result / "observations.json" if options.observations is None else options.observations
    if path.is_file():
        show(track_table(read_coco(path)))


def _edit(kind: str, text: str) -> Edit:
    """Return the edit of an option such as `--swap 3,5@120:140`."""
    match = re.fullmatch(r"(\d{1,9}(?:,\d{1,9})*)(?:@(\d{1,9})(?::(\d{1,9}))?)?", text)
    named, *ends = match.groups() if match else ("", None, None)
    numbers = tuple(int(part) for part in named.split(",") if part)
    start, stop = (None if end is None else int(end) for end in ends)
    wrong = not numbers or (_TRACKS[kind] or len(numbers)) != len(numbers)
    wrong |= kind == "cut" and (start is None or stop is not None)
    wrong |= kind in ("join", "delete") and start is not None
    if wrong:
        examples = {"swap": "3,5@120", "cut": "4@80", "join": "2,7", "delete": "6"}
        raise InputError(f"--{kind}", f"cannot be '{text}'", f"write for example --{kind} {examples[kind]}")
    return Edit(kind, numbers, start, stop)
