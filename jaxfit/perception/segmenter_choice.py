"""The choice between the built-in and the general segmenter on some frames of a video, for `--segmenter auto`.

The built-in segmenter is used where trust in it is high, and otherwise the general segmenter, if it detects a bird. The
reason is what the networks know. The built-in networks know simulated murres only, and trust
(`jaxfit.perception.trust`) measures how far the footage is from this training: inside, their quality is known; outside,
nothing is known about them. The general segmenter is trained on photographs of birds of all kinds, so a bird that it
detects in a frame and in the mirror image is evidence that does not depend on murres. No property of the masks is
compared, because a network can be consistently wrong, with stable masks of rocks.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxfit.config.perception import AUTO, BUILTIN, FramesConfig, SegmenterConfig, TrackConfig
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.perception.detections import expected_frames, open_keypoint_detector, open_segmenter, single_opencv_thread
from jaxfit.perception.general_networks import COMMAND, check_general_files, installed_general
from jaxfit.perception.merging import MIN_SAME_IOU, mask_iou
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter
from jaxfit.perception.trust import FootageSignals, Trust, judge
from jaxfit.video.reader import read_frames

FRAMES = 8
"""Number of frames, spread evenly over the video, on which the segmenter is chosen."""

_logger = logging.getLogger(__name__)


Pictures = Sequence[UInt8[np.ndarray, "H W 3"]]


class SegmenterChoice(NamedTuple):
    """The segmenter of a video, and why."""

    segmenter: str
    """`builtin`, or the name of a general segmenter."""
    reason: str
    """Why, in one sentence without a full stop."""
    is_compared: bool
    """Whether the built-in networks ran on frames of the video."""

    def sentence(self) -> str:
        """Return the choice for the user, in one line."""
        return f"segmenter: {self.segmenter} ({self.reason})"

    def info(self) -> dict[str, str]:
        """Return the choice as texts, for the files of a result; empty without a comparison."""
        return {"segmenter": self.segmenter, "segmenter_reason": self.reason} if self.is_compared else {}


def with_chosen_segmenter(
    source: str | Path, config: TrackConfig, progress: ProgressTask = silent, pictures: Pictures | None = None
) -> tuple[TrackConfig, SegmenterChoice | None]:
    """Return the config with the chosen segmenter in place of `auto`, and the choice; None if the config names one.

    Args:
        source: a video, or a folder of frames.
        config: the settings of tracking.
        progress: reports every frame.
        pictures: the pictures on which the networks run; None for frames that are spread over the video.

    Raises:
        InputError: the video cannot be read, or a network cannot be used.
    """
    if config.segmenter.file != AUTO:
        return config, None
    choice = choose_segmenter(source, config, progress, pictures)
    return _with_segmenter(config, choice.segmenter), choice


def choose_segmenter(
    source: str | Path, config: TrackConfig, progress: ProgressTask = silent, pictures: Pictures | None = None
) -> SegmenterChoice:
    """Choose between the built-in and the general segmenter; arguments and errors as `with_chosen_segmenter`.

    Settings that describe one network (`kind`, `names`) choose the built-in segmenter, and no network runs. Without the
    files of the general segmenter, a warning says which command downloads them if trust is low.
    """
    settings = config.segmenter
    if (settings.kind, settings.names) != (SegmenterConfig.kind, SegmenterConfig.names):
        return SegmenterChoice(BUILTIN, "`kind` or `names` describes one network", is_compared=False)
    pictures = _spread_pictures(source, config.frames) if pictures is None else pictures
    if not pictures:
        return SegmenterChoice(BUILTIN, "no frame of the video can be read", is_compared=False)
    with single_opencv_thread(), progress("Choosing the segmenter", None) as report_progress:
        builtin = open_segmenter(_with_segmenter(config, BUILTIN))
        birds = []
        for picture in pictures:
            birds.append(builtin(picture))
            report_progress(1, "")
        trust = first_trust(builtin, open_keypoint_detector(config), pictures, birds)
        where = f"on {counted(len(pictures), 'frame')}"
        if trust.level == "high":
            return SegmenterChoice(BUILTIN, f"trust is high {where}", is_compared=True)
        name = installed_general()
        if name is None:
            reason = f"trust is low {where}; for birds of other species, run `{COMMAND}` first"
            _logger.warning("%s: trust in the built-in networks is low; run `%s` first", source, COMMAND)
            return SegmenterChoice(BUILTIN, reason, is_compared=True)
        try:
            check_general_files(name)
        except InputError as error:
            _logger.warning("%s: `auto` uses the built-in segmenter", error)
            return SegmenterChoice(BUILTIN, f"a file of the segmenter `{name}` cannot be used", is_compared=True)
        general = open_segmenter(_with_segmenter(config, name))
        for picture in pictures:
            report_progress(1, "")
            if _has_bird(general, picture):
                reason = f"trust in the built-in segmenter is low {where}, and {name} detects birds"
                return SegmenterChoice(name, reason, is_compared=True)
    return SegmenterChoice(BUILTIN, f"trust is low, but {name} detects no bird {where}", is_compared=True)


def first_trust(
    segmenter: Segmenter,
    keypoints: KeypointDetector,
    pictures: Sequence[UInt8[np.ndarray, "H W 3"]],
    birds: Sequence[list[Instance]],
) -> Trust:
    """Judge single pictures by the signals that need no tracks.

    Args:
        segmenter: the segmenter, after it has detected the birds; the distances of its activations are taken.
        keypoints: the keypoint network.
        pictures: the pictures.
        birds: the birds of every picture.
    """
    confidences = [keypoints(picture, own)[1].mean(-1) for picture, own in zip(pictures, birds, strict=True) if own]
    monitors = [getattr(network, "activations", None) for network in (segmenter, keypoints)]
    distances = [() if monitor is None else monitor.take().tolist() for monitor in monitors]
    frame_distance, bird_distance = (float(np.median(values)) if len(values) else None for values in distances)
    scores = [bird.score for own in birds for bird in own]
    is_calibrated = getattr(keypoints, "curve", None) is not None and confidences
    return judge(
        FootageSignals(
            birds_per_frame=len(scores) / len(pictures),
            tracks=len(scores),
            score=float(np.median(scores)) if scores and frame_distance is not None else None,
            confidence=float(np.median(np.concatenate(confidences))) if is_calibrated else None,
            frame_distance=frame_distance,
            bird_distance=bird_distance,
        )
    )


def _has_bird(segmenter: Segmenter, picture: UInt8[np.ndarray, "H W 3"]) -> bool:
    """Whether a segmenter detects a bird in a picture and, at the same place, in the mirror image."""
    birds = segmenter(picture)
    mirrored = _mirrored_birds(segmenter, picture) if birds else []
    return any(mask_iou(bird, other) > MIN_SAME_IOU for bird in birds for other in mirrored)


def _mirrored_birds(segmenter: Segmenter, picture: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
    """Detect the birds of the mirror image, and mirror them back."""
    width = picture.shape[1]
    birds = segmenter(np.ascontiguousarray(picture[:, ::-1]))
    return [bird._replace(mask=bird.mask[:, ::-1], x0=width - bird.x0 - bird.mask.shape[1]) for bird in birds]


def _with_segmenter(config: TrackConfig, name: str) -> TrackConfig:
    return replace(config, segmenter=replace(config.segmenter, file=name))


def _spread_pictures(source: str | Path, frames: FramesConfig) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Return up to `FRAMES` pictures in the middle of equal parts of the video, or the first if its length is unknown.

    Frames that cannot be read are skipped.

    Raises:
        InputError: the file is not a video.
    """
    total = expected_frames(read_frames(source, frames.start, frames.stop, frames.step), frames)
    count = FRAMES if total is None else min(FRAMES, total)
    positions = range(count) if total is None else (int((i + 0.5) * total / count) for i in range(count))
    pictures = []
    for position in positions:
        number = frames.start + position * frames.step
        with suppress(InputError):  # damage; tracking reports a video without any frame
            pictures += [frame.picture for frame in read_frames(source, number, number + 1)]
    return pictures
