"""The networks of a config: loading, checks and files."""

from __future__ import annotations

from pathlib import Path

from jaxfit.config.checks import require
from jaxfit.config.perception import TrackConfig
from jaxfit.perception.instances import KeypointDetector, Segmenter
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.keypoints.detector import BUILTIN_PATH
from jaxfit.perception.segmentation import KINDS, load_segmenter, segmenter_files

__all__ = ["check_segmenter", "network_files", "open_keypoint_detector", "open_segmenter"]


def open_segmenter(config: TrackConfig, min_score: float | None = None) -> Segmenter:
    """Load the segmenter of a config.

    Args:
        config: the whole config of tracking.
        min_score: replaces the score of the config; None keeps the score of the config.

    Raises:
        InputError: the segmenter cannot be used.
    """
    settings = config.segmenter
    require(settings.kind in KINDS, "track.segmenter.kind", f"is {settings.kind!r}", f"one of {', '.join(KINDS)}")
    return load_segmenter(
        settings.file,
        kind=settings.kind,
        names=settings.names or None,
        classes=settings.classes or None,
        min_score=settings.min_score if min_score is None else min_score,
        tile_px=settings.tile_px,
        tile_overlap=settings.tile_overlap,
        threads=config.threads,
    )


def check_segmenter(config: TrackConfig) -> None:
    """Load the segmenter of a config and release it, to report an unusable segmenter before long work.

    Raises:
        InputError: the segmenter cannot be used.
    """
    open_segmenter(config)


def open_keypoint_detector(config: TrackConfig) -> KeypointDetector:
    """Load the keypoint detector of a config.

    Raises:
        InputError: the keypoint detector cannot be used.
    """
    settings = config.keypoints
    return load_keypoint_detector(
        settings.file,
        kind=settings.kind,
        names=settings.names or None,
        pad_px=settings.pad_px,
        dilate_px=settings.dilate_px,
        batch=settings.batch,
        threads=config.threads,
    )


def network_files(config: TrackConfig) -> dict[str, list[Path]]:
    """Return the files of the networks of a config, under the keys `segmenter` and `keypoints`."""
    keypoints = BUILTIN_PATH if config.keypoints.file == "builtin" else Path(config.keypoints.file)
    return {"segmenter": segmenter_files(config.segmenter.file), "keypoints": [keypoints]}
