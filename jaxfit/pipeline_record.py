"""What the parts of an unfinished reconstruction depend on: video, settings, networks, model and versions."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxfit.config.build import plain_config
from jaxfit.config.fit import FitConfig
from jaxfit.config.perception import TrackConfig
from jaxfit.extras import LIBRARIES, TRACKING_LIBRARIES, library_versions
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash
from jaxfit.progress import ProgressTask, silent
from jaxfit.video.pictures import image_files

__all__ = ["file_hashes", "fit_record", "tracking_record"]

_AFTER_TRACKING = ("min_track_frames", "min_track_score", "repair_left_right_flips")
"""Settings of tracking that are applied to the stored frames."""
_FORMAT_VERSION = 1
"""Version of the stored frames and windows."""
_BLOCK_BYTES = 1 << 22


def tracking_record(
    config: TrackConfig, video: Path, networks: dict[str, dict[str, str]], progress: ProgressTask = silent
) -> dict[str, Any]:
    """Return what the stored frames of a video depend on.

    Args:
        config: the settings of tracking.
        video: a video, or a folder of frames; its content counts, not its folder.
        networks: the hashes of the networks (`file_hashes`).
        progress: reports the bytes of the video that were read.
    """
    settings = {key: value for key, value in plain_config(config).items() if key not in _AFTER_TRACKING}
    files = image_files(video) if video.is_dir() else [video]
    with progress("Checking the video", sum(file.stat().st_size for file in files)) as report_progress:
        content = _content_hash(files, lambda size: report_progress(size, ""))
    return {
        "track": settings,
        "video": {"name": video.name, "content": content},
        "networks": networks,
        "versions": library_versions(("jaxfit", "numpy", *TRACKING_LIBRARIES)),
        "format_version": _FORMAT_VERSION,
    }


def fit_record(config: FitConfig, bird: Bird) -> dict[str, Any]:
    """Return what the stored windows depend on, beside the content of each window."""
    return {
        "fit": {key: value for key, value in plain_config(config).items() if key != "memory_gb"},
        "model": model_hash(bird),
        "versions": library_versions(LIBRARIES),
        "format_version": _FORMAT_VERSION,
    }


def file_hashes(networks: dict[str, list[Path]]) -> dict[str, dict[str, str]]:
    """Return kind → name → SHA-256 hash of the files of networks."""
    return {kind: {file.name: _content_hash([file]) for file in files} for kind, files in networks.items()}


def _content_hash(files: Sequence[Path], report_bytes: Callable[[int], object] = lambda _: None) -> str:
    """Return the SHA-256 hash of a file, or of the names and contents of several files."""
    digest = hashlib.sha256()
    for file in files:
        one = hashlib.sha256()
        with file.open("rb") as opened:
            while block := opened.read(_BLOCK_BYTES):
                one.update(block)
                report_bytes(len(block))
        if len(files) == 1:
            return one.hexdigest()
        digest.update(f"{file.name!a} ".encode() + one.digest())
    return digest.hexdigest()
