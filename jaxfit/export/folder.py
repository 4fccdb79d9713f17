"""Exports that are folders with one file for each bird, and `export.json` that describes the files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxfit.export.result import Exported
from jaxfit.storage.files import new_folder, write_whole
from jaxfit.storage.json_values import json_text

__all__ = ["MARKER", "describe_tracks", "export_folder"]

MARKER = "export.json"
"""Name of the file that every folder of an export contains."""


@contextmanager
def export_folder(
    exported: Exported, out: Path, overwrite: bool, names: dict[int, str], further: dict[str, Any]
) -> Iterator[Path]:
    """Write the folder of an export, completely or not at all, as a context manager; yields a temporary folder.

    Args:
        exported: the result.
        out: the folder.
        overwrite: replace an earlier export in the folder.
        names: track → name of its file; a track without a pose has no file.
        further: further entries of `export.json`; the body may add entries.

    Raises:
        InputError: the folder holds other files, or cannot be written.
    """
    with new_folder(out, overwrite, MARKER) as part:
        yield part
        facts = {"source_software": "jaxfit", "unit_of_lengths": exported.unit, "fps": exported.fps}
        tracks = describe_tracks(exported)
        for track, name in names.items():
            tracks[str(track)]["file"] = name
        write_whole(part / MARKER, json_text(facts | further | {"tracks": tracks}).encode())


def describe_tracks(exported: Exported) -> dict[str, dict[str, Any]]:
    """Return the status, the number of poses, the failures and the quality of every track, for JSON."""
    s = exported.solution
    tracks = {}
    for n, track in enumerate(s.track_id.tolist()):
        facts: dict[str, Any] = {"status": str(s.status[n]), "poses": int(s.valid[n].sum())}
        if track in exported.quality:
            facts["quality"] = exported.quality[track]._asdict()
        tracks[str(track)] = facts
    return tracks
