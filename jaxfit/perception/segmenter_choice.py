"""The choice between the built-in and the general segmenter on some frames of a video, for `--segmenter auto`.

Trust (`jaxfit.perception.trust`) cannot compare the two segmenters: most of its signals compare a network with its own
training, and only networks of `jaxfit train` store the statistics for that; the other signals need consecutive frames.
High trust in the built-in segmenter decides alone. Under low trust, the agreement decides, which is defined for every
segmenter. Each segmenter runs on every frame and on its mirror image. A bird is stable if both runs detect the bird: a
pair of masks with an IoU above ½, whose intersection is the stable mask. With the pixels S of all stable masks and the
pixels D of all masks of both runs, summed over the frames,

    agreement of a = Σ |S_a| / Σ |D_a ∪ S_b|,

where b is the other segmenter. Masks that only one run detects lower the agreement, and so do birds that only the other
segmenter detects in both runs. Without the term S_b, a segmenter that detects few birds reliably would win against a
segmenter that detects all birds.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.config.perception import AUTO, BUILTIN, GENERAL, FramesConfig, SegmenterConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.perception.detections import expected_frames, open_keypoint_detector, open_segmenter, single_opencv_thread
from jaxfit.perception.general_networks import check_general_files, general_files
from jaxfit.perception.merging import mask_iou
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter
from jaxfit.perception.trust import FootageSignals, Trust, judge
from jaxfit.video.reader import read_frames

FRAMES = 8
"""Number of frames, spread evenly over the video, on which the segmenters are compared."""
MIN_IOU = 0.5
"""Masks with a larger IoU are a pair, which is the usual limit of a matching detection (Everingham et al. 2010)."""

_logger = logging.getLogger(__name__)


class SegmenterChoice(NamedTuple):
    """The segmenter of a video, and why."""

    segmenter: str
    """`builtin` or `general`."""
    reason: str
    """Why, in one sentence without a full stop."""
    is_compared: bool
    """Whether the segmenters ran on frames of the video; False without the files of the general segmenter."""

    def sentence(self) -> str:
        """Return the choice for the user, in one line."""
        return f"segmenter: {self.segmenter} ({self.reason})"

    def info(self) -> dict[str, str]:
        """Return the choice as texts, for the files of a result; empty without a comparison."""
        return {"segmenter": self.segmenter, "segmenter_reason": self.reason} if self.is_compared else {}


def with_chosen_segmenter(
    source: str | Path, config: TrackConfig, progress: ProgressTask = silent
) -> tuple[TrackConfig, SegmenterChoice | None]:
    """Return the config with the chosen segmenter in place of `auto`, and the choice; None if the config names one.

    Args:
        source: a video, or a folder of frames.
        config: the settings of tracking.
        progress: reports every frame.

    Raises:
        InputError: the video cannot be read, or a network cannot be used.
    """
    if config.segmenter.file != AUTO:
        return config, None
    choice = choose_segmenter(source, config, progress)
    return _with_segmenter(config, choice.segmenter), choice


def choose_segmenter(source: str | Path, config: TrackConfig, progress: ProgressTask = silent) -> SegmenterChoice:
    """Choose between the built-in and the general segmenter; arguments and errors as `with_chosen_segmenter`.

    Without the files of the general segmenter, or with settings that describe one network (`kind`, `names`), the
    function runs no network and chooses the built-in segmenter.
    """
    settings = config.segmenter
    if (settings.kind, settings.names) != (SegmenterConfig.kind, SegmenterConfig.names):
        return SegmenterChoice(BUILTIN, "`kind` or `names` describes one network", is_compared=False)
    if not any(path.exists() for path in general_files()):
        reason = "for birds of other species, run `jaxfit networks get general` first"
        return SegmenterChoice(BUILTIN, reason, is_compared=False)
    try:
        check_general_files()
    except InputError as error:
        _logger.warning("%s: `auto` uses the built-in segmenter", error)
        return SegmenterChoice(BUILTIN, "a file of the segmenter `general` cannot be used", is_compared=False)
    pictures = _spread_pictures(source, config.frames)
    if not pictures:
        return SegmenterChoice(BUILTIN, "no frame of the video can be read", is_compared=False)
    with single_opencv_thread():
        return _compare(pictures, config, progress)


def _compare(
    pictures: Sequence[UInt8[np.ndarray, "H W 3"]], config: TrackConfig, progress: ProgressTask
) -> SegmenterChoice:
    """Choose the segmenter of some pictures."""
    builtin = open_segmenter(_with_segmenter(config, BUILTIN))
    keypoints = open_keypoint_detector(config)
    with progress("Choosing the segmenter", None) as report_progress:

        def detected(segmenter: Segmenter, mirrored: bool = False) -> list[list[Instance]]:
            birds = []
            for picture in pictures:
                birds.append(_mirrored_birds(segmenter, picture) if mirrored else segmenter(picture))
                report_progress(1, "")
            return birds

        own = detected(builtin)
        trust = first_trust(builtin, keypoints, pictures, own)
        if trust.level == "high":
            return SegmenterChoice(BUILTIN, f"trust is high on {len(pictures)} frames", is_compared=True)
        general = open_segmenter(_with_segmenter(config, GENERAL))
        others = detected(general)
        if not any(others):
            what = "the general segmenter detects no bird" if any(own) else "no bird was detected"
            return SegmenterChoice(BUILTIN, f"{what} on {len(pictures)} frames", is_compared=True)
        runs = (own, detected(builtin, mirrored=True)), (others, detected(general, mirrored=True))
    of_builtin, of_general = agreements(*runs, (pictures[0].shape[1], pictures[0].shape[0]))
    name, other = (GENERAL, BUILTIN) if of_general > of_builtin else (BUILTIN, GENERAL)
    better, worse = max(of_general, of_builtin), min(of_general, of_builtin)
    reason = f"agreement with the mirror image {better:.2f}, {other} {worse:.2f}, on {len(pictures)} frames"
    return SegmenterChoice(name, reason, is_compared=True)


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


Runs = tuple[Sequence[Sequence[Instance]], Sequence[Sequence[Instance]]]
"""The birds of every frame, and the birds of every mirror image, mirrored back."""


def agreements(first: Runs, second: Runs, size_px: tuple[int, int]) -> tuple[float, float]:
    """Compute the agreement of two segmenters, each within [0, 1]; 0 without any bird.

    Args:
        first, second: the birds of the segmenters in the same frames.
        size_px: width and height of the frames.
    """
    stable, contested = np.zeros(2), np.zeros(2)
    for own, other in zip(zip(*first, strict=True), zip(*second, strict=True), strict=True):
        (own_stable, own_all), (other_stable, other_all) = _pixels(*own, size_px), _pixels(*other, size_px)
        stable += own_stable.sum(), other_stable.sum()
        contested += (own_all | other_stable).sum(), (other_all | own_stable).sum()
    of_first, of_second = (stable / np.maximum(contested, 1)).tolist()
    return of_first, of_second


def _pixels(
    birds: Sequence[Instance], mirrored: Sequence[Instance], size_px: tuple[int, int]
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Return the pixels of the stable masks and of all masks of two runs on one frame."""
    stable, reported = (np.zeros(size_px[::-1], bool) for _ in range(2))
    for bird in (*birds, *mirrored):
        _window(reported, bird)[:] |= bird.mask
    iou = np.array([[mask_iou(a, b) for b in mirrored] for a in birds]).reshape(len(birds), len(mirrored))
    for i, j in zip(*linear_sum_assignment(iou, maximize=True), strict=True):
        if iou[i, j] > MIN_IOU:
            both = np.zeros_like(stable)
            _window(both, birds[i])[:] = birds[i].mask
            part = _window(both, mirrored[j])
            _window(stable, mirrored[j])[:] |= part & mirrored[j].mask
    return stable, reported


def _window(pixels: Bool[np.ndarray, "H W"], bird: Instance) -> Bool[np.ndarray, "h w"]:
    """Return the part of a frame that the mask of a bird covers, as a view."""
    height, width = bird.mask.shape
    return pixels[bird.y0 : bird.y0 + height, bird.x0 : bird.x0 + width]


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
