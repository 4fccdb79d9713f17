"""`export_result`: a result in a format of another tool."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from jaxfit.export import FORMATS
from jaxfit.export.result import MARKER, open_result
from jaxfit.export.tables import angles_path
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_new_file, check_replaceable, check_writable
from jaxfit.foundation.progress import ProgressTask, silent


class Export(NamedTuple):
    """The files of an export, and facts about the files."""

    files: list[Path]
    unit: str
    """Unit of lengths: `m`, or `unit` (model units) where the length of a model unit is unknown."""
    notes: list[str]
    """Sentences about what the format cannot hold."""


def export_result(
    result: str | Path,
    to: str,
    out: str | Path,
    *,
    tracks: Sequence[int] | None = None,
    frames: tuple[int | None, int | None] = (None, None),
    fps: float | None = None,
    metres_per_unit: float | None = None,
    video: str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressTask = silent,
    **options: Any,
) -> Export:
    """Write a result in a format of another tool, completely or not at all.

    Args:
        result: folder of `jaxfit fit` or `jaxfit reconstruct`.
        to: a name of `jaxfit.export.FORMATS`: `csv`, `parquet`, `movement`, `coco`, `slp`, `dlc`, `glb`, `nwb`.
        out: the file to write. A folder, with a file for every bird, for `nwb`, and for `glb` unless the name ends with
            `.glb`.
        tracks: ids of the tracks; None exports all tracks.
        frames: number of the first frame, and number after the last frame; None is an end of the result.
        fps: frame rate of the footage in frames per second; None takes the times and the rate of the result.
        metres_per_unit: length of a model unit in metres; None takes the length that the model states.
        video: the footage; None takes the footage that the result names.
        overwrite: replace existing files, or an earlier export in the folder.
        progress: shows progress.
        **options: options of the format: `space` ("2d", "3d", "world") and `dims` ("singular", "plural") of `movement`;
            `ground` (bool) of `glb`; `start` (ISO 8601, time of frame 0) of `nwb`.

    Returns:
        The written files, the unit of lengths, and notes.

    Raises:
        InputError: the result cannot be read or lacks a track or a frame, the frame rate or the footage is unknown but
            required, an optional package is missing or too old, an option does not belong to the format, or the output
            exists or cannot be written; or positions in the world are required of a result without a world.
    """
    if to not in FORMATS:
        raise InputError("--to", f"is {to}, which is no format", f"choose one of: {', '.join(FORMATS)}")
    form, out = FORMATS[to], Path(out)
    chosen = {name: value for name, value in options.items() if value is not None and value is not False}
    foreign = [name for name in chosen if name not in form.options]
    if foreign:
        option = f"--{foreign[0].replace('_', '-')}"
        problem = f"does not belong to the format {to}"
        raise InputError(option, problem, f"remove {option}, or choose another format")
    to_folder = form.folder and out.suffix not in form.suffixes
    _check_out(out, to_folder, to, overwrite)
    exported = open_result(result, tracks, frames, fps, metres_per_unit, video)
    if to_folder:
        chosen["overwrite"] = overwrite
    written = getattr(import_module(f"jaxfit.export.{form.module}"), form.function)(exported, out, progress, **chosen)
    files, notes = written if isinstance(written, tuple) else (written, [])
    return Export(files, exported.unit, notes)


def _check_out(out: Path, to_folder: bool, to: str, overwrite: bool) -> None:
    """Raise InputError if the output exists or cannot be written, before the long work."""
    form = FORMATS[to]
    if to_folder:
        if out.suffix in {".nwb", *(suffix for each in FORMATS.values() for suffix in each.suffixes)}:
            end = "".join(f", or of a file that ends with {suffix}" for suffix in form.suffixes)
            problem = f"is the name of a file, but {to} writes a folder with a file for every bird"
            raise InputError(out, problem, f"give the name of a folder{end}")
        check_replaceable(out, overwrite, MARKER)
        return
    if out.suffix not in form.suffixes:
        expected = " or ".join(form.suffixes)
        raise InputError(out, f"must end with {expected}", "choose another --out")
    for path in (out, angles_path(out)) if form.module == "tables" else (out,):
        check_new_file(path, overwrite)
    check_writable(out)
