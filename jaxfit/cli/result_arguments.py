"""The arguments of `report`, `export`, `tracks`, `join` and `doctor`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from jaxfit.cli.arguments import add_command, add_force, add_out
from jaxfit.export.formats import FORMATS

__all__ = ["add_result_commands"]


def add_result_commands(commands: Any) -> None:
    """Add the commands."""
    _report(commands)
    _export(commands)
    _tracks(commands)
    _join(commands)
    text = "check the installation: kernels, FFmpeg, codecs, networks, optional packages, cache"
    add_command(commands, "doctor", "doctor.doctor", text)


def _report(commands: Any) -> None:
    text = "write a report of a result as one HTML page: quality, warnings, pictures, timeline"
    report = add_command(commands, "report", "reporting.report", text)
    report.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    text = "the footage, if the result does not name the footage, or the footage was moved"
    report.add_argument("--video", type=Path, help=text)
    text = "file to write (default: report.html in the folder of the result, which replaces an earlier report)"
    report.add_argument("--out", type=Path, metavar="HTML", help=text)
    report.add_argument("--overwrite", action="store_true", help="replace an existing file of --out")
    add_force(report)


def _export(commands: Any) -> None:
    text = "write a result in a format that other tools open"
    export = add_command(commands, "export", "exporting.export", text)
    export.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    tools = "; ".join(f"{name} ({form.tools})" for name, form in FORMATS.items())
    export.add_argument("--to", required=True, choices=tuple(FORMATS), metavar="FORMAT", help=f"format: {tools}")
    text = "file to write; a folder for nwb, and for glb without --one-file"
    add_out(export, "PATH", text, overwrite="existing files, or an earlier export in the folder")
    export.add_argument("--tracks", metavar="ID,ID", help="only these tracks")
    text = "only the frames from number A to number B − 1; A or B may be left out"
    export.add_argument("--frames", metavar="A:B", help=text)
    text = "frame rate of the footage, if the result does not hold the rate, or holds a wrong rate"
    export.add_argument("--fps", type=float, help=text)
    text = "length of a model unit in metres, for models that do not state the length"
    export.add_argument("--metres-per-unit", type=float, metavar="M", help=text)
    text = "the footage, if the result does not name the footage, or the footage was moved"
    export.add_argument("--video", type=Path, help=text)
    text = "movement: keypoints in image pixels (2d, the default) or in the camera frame (3d)"
    export.add_argument("--space", choices=("2d", "3d"), help=text)
    text = "movement: names of the dimensions; plural for movement before 0.17 (default singular)"
    export.add_argument("--dims", choices=("singular", "plural"), help=text)
    text = "nwb: time of frame 0 of the footage, such as 2024-06-01T12:00:00+02:00"
    export.add_argument("--start", metavar="TIME", help=text)
    export.add_argument("--one-file", action="store_true", help="glb: all birds in one file")
    export.add_argument("--ground", action="store_true", help="glb: add a level ground below the feet of the birds")


class _AddEdit(argparse.Action):
    """Collects the corrections in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        edits = [*(namespace.edits or []), ((option_string or "").lstrip("-"), values)]
        namespace.edits = edits


def _tracks(commands: Any) -> None:
    text = "list the tracks of a result, or correct the tracks and fit only the windows that change"
    tracks = add_command(commands, "tracks", "correcting.tracks", text)
    tracks.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    for option, metavar, what in (
        ("--swap", "ID,ID@A:B", "exchange two tracks, from frame A to frame B − 1 (or to the end, or everywhere)"),
        ("--cut", "ID@A", "the frames from A on become a new track"),
        ("--join", "ID,ID", "the second track becomes a part of the first track"),
        ("--delete", "ID,ID", "delete tracks"),
    ):
        text = f"{what}; may be repeated, corrections happen in their order"
        tracks.add_argument(option, dest="edits", action=_AddEdit, metavar=metavar, help=text)
    text = "the file that was fitted, for a result of `jaxfit fit`"
    tracks.add_argument("--observations", type=Path, metavar="OBS.json", help=text)
    tracks.add_argument("--out", type=Path, metavar="DIR", help="folder for the corrected result")
    text = "replace an earlier result in the folder of --out"
    tracks.add_argument("--overwrite", action="store_true", help=text)


def _join(commands: Any) -> None:
    text = "join the results of ranges of one video, and continue tracks across the cuts by place and size"
    join = add_command(commands, "join", "correcting.join", text)
    text = "folders of `jaxfit reconstruct --start A --stop B`, in any order"
    join.add_argument("results", type=Path, nargs="+", metavar="RESULT", help=text)
    text = "a track may continue after so many frames without the bird (default: the memory of the tracker)"
    join.add_argument("--bridge", type=int, metavar="FRAMES", help=text)
    add_out(join, "DIR", "folder for the joined result", overwrite="an earlier result in the folder")
