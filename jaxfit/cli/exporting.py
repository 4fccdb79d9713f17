"""The command that exports a result."""

from __future__ import annotations

import argparse
import re

from jaxfit.cli.tables import counted, show
from jaxfit.errors import InputError
from jaxfit.progress import terminal

__all__ = ["export", "frame_range", "track_ids"]


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
        one_file=options.one_file,
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
        InputError: the text is not a range of frames.
    """
    match = re.fullmatch(r"(\d{1,9})?:(\d{1,9})?", text or ":")
    if match is None:
        raise InputError("--frames", f"is '{text}', not a range of frames", "write for example --frames 100:200")
    first, stop = (None if part is None else int(part) for part in match.groups())
    return first, stop
