"""`report`, `export`, `tracks`, `join`."""

from __future__ import annotations

import argparse
import re

import numpy as np

from jaxfit.cli.tables import right_aligned, show, track_table
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import terminal
from jaxfit.review.edits import EXAMPLES, Edit, parse_edit, read_edits
from jaxfit.review.points import Point


def tracks(options: argparse.Namespace) -> None:
    """List the tracks of a result, or correct the tracks and fit what changes."""
    if not options.edits and options.edits_file is None:
        if options.out is not None:
            known = ", ".join(f"--{kind}" for kind in EXAMPLES)
            raise InputError("tracks", "has --out, but no correction", f"give {known} or --edits")
        _list(options)
        return
    if options.out is None:
        raise InputError("tracks", "has corrections, but no folder for the new result", "give --out")
    from jaxfit.review.correct import correct_tracks

    edits = [] if options.edits_file is None else read_edits(options.edits_file)
    edits += [_edit(kind, text) for kind, text in options.edits or []]
    if not edits:
        example = f"swap {EXAMPLES['swap']}"
        raise InputError(options.edits_file, "holds no correction", f"write one a line, for example {example}")
    done = correct_tracks(
        options.result, options.out, edits, options.observations, options.overwrite, progress=terminal
    )
    for track, first, last in done.fitted:
        show(f"fitted again: track {track}, frames {first} to {last}")
    show(f"{len(done.fitted)} of {counted(done.windows, 'window')} fitted again → {options.out}")
    show(f"jaxfit overlay {options.out} --video VIDEO --out overlay.mp4 draws the new result")


def join(options: argparse.Namespace) -> None:
    """Join the results of ranges of one video."""
    from jaxfit.review.join import join_results

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
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.result_folder import OBSERVATIONS
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
    path = options.observations or options.result / OBSERVATIONS
    if options.observations is not None or path.is_file():
        show(track_table(read_observations(path)))


def _edit(kind: str, text: str) -> Edit | Point:
    """Return the edit of an option such as `--swap 3,5@120:140`."""
    try:
        return parse_edit(f"{kind} {text}", f"--{kind}")
    except InputError:
        remedy = f"write for example --{kind} {EXAMPLES[kind]}"
        if kind == "exclude":
            remedy += "; --delete removes all frames of a track"
        raise InputError(f"--{kind}", f"cannot be '{text}'", remedy) from None


def export(options: argparse.Namespace) -> None:
    """Write a result in a format of another tool."""
    from jaxfit.export.export import export_result

    done = export_result(
        options.result,
        options.to,
        options.out,
        tracks=None if options.tracks is None else track_ids(options.tracks),
        frames=frame_range(options.frames),
        fps=options.fps,
        metres_per_unit=options.metres_per_unit,
        video=options.video,
        overwrite=options.overwrite,
        progress=terminal,
        space=options.space,
        dims=options.dims,
        ground=options.ground,
        start=options.start,
    )
    for note in done.notes:
        show(note)
    for path in done.files:
        show(f"{path} ({path.stat().st_size / 1e6:.2f} MB)")
    if done.unit == "unit" and options.to not in ("coco", "slp", "dlc"):
        show("lengths are in model units: the model does not state the length of its unit (--metres-per-unit)")
    show(f"{counted(len(done.files), 'file')} for {options.to}")


def track_ids(text: str) -> list[int]:
    """Return the ids of `--tracks 1,4`.

    Raises:
        InputError: the text is not a list of numbers.
    """
    if not re.fullmatch(r"\d{1,18}(,\d{1,18})*", text):
        raise InputError("--tracks", f"is '{text}', not a list of track ids", "write for example --tracks 1,4")
    return [int(part) for part in text.split(",")]


def frame_range(text: str | None) -> tuple[int | None, int | None]:
    """Return the two ends of `--frames A:B`; an end that is left out is None.

    Raises:
        InputError: the text is not a range of frames, or the range is empty.
    """
    match = re.fullmatch(r"(\d{1,9})?:(\d{1,9})?", ":" if text is None else text)
    if match is None:
        raise InputError("--frames", f"is '{text}', not a range of frames", "write for example --frames 100:200")
    first, stop = (None if part is None else int(part) for part in match.groups())
    if first is not None and stop is not None and stop <= first:
        raise InputError("--frames", f"is '{text}': the range is empty", "B is left out, so give a B above A")
    return first, stop


def report(options: argparse.Namespace) -> None:
    """Write the report of a result."""
    from functools import partial

    from jaxfit.behaviour.result import behaviour_of_result
    from jaxfit.view.report.write import report_of_result

    describe = partial(behaviour_of_result, progress=terminal)
    path = report_of_result(options.result, options.video, options.out, options.overwrite, options.force, describe)
    show(f"{path} ({path.stat().st_size / 1e6:.2f} MB): open it in a browser")
