"""Names of the files of a result folder, and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxfit.data.formats.fields import read_json
from jaxfit.foundation.errors import InputError

POSES = "poses.npz"
"""File that marks a result folder."""
MODEL, CONFIG, LEARNT, SUMMARY = "model.npz", "config.yaml", "learnt.yaml", "summary.json"
OBSERVATIONS, CAMERAS, OVERLAY = "observations.json", "cameras.toml", "overlay.mp4"


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the content of `summary.json` of a result; empty if the file is absent.

    Raises:
        InputError: the file cannot be read, or holds no object.
    """
    path = folder / SUMMARY
    return {key: each.value for key, each in read_json(path).entries()} if path.is_file() else {}


def check_is_of_video(folder: Path, summary: Mapping[str, Any], remedy: str) -> None:
    """Raise InputError with a remedy if a result holds photographs."""
    if summary.get("photographs"):
        raise InputError(folder, "holds photographs, which are not the frames of one video", remedy)


def named_footage(summary: Mapping[str, Any]) -> Path | None:
    """Return the footage that a summary names; a relative path begins in the folder where the command ran."""
    video = summary.get("video")
    file = video.get("file") if isinstance(video, dict) else None
    return Path(file) if isinstance(file, str) and file and "\0" not in file else None
