"""Photographs of a species as the adaptation reads them: usable images, individuals, crops, masks and initial poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.fitting.crops import cut_mask
from jaxfit.fitting.fit import fit
from jaxfit.fitting.solve import needs_mask
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird
from jaxfit.model.camera import image_to_crop
from jaxfit.model.kinematics import Pose

MASK_PX = 128
"""Side of the masks and silhouettes that are compared, in pixels."""
FRAMES_PER_TRACK = 10
"""Most images of one track, if nothing else is given: the frames of a track show one individual again and again."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """N images of a species, each with its bird in a crop."""

    names: tuple[str, ...]
    """Names for messages: file, image and track."""
    individual: Int[np.ndarray, "N"]
    """Number of the individual, from 0. All images of one track show one individual."""
    keypoints_px: Float[np.ndarray, "N K 2"]
    """Crop pixels."""
    confidence: Float[np.ndarray, "N K"]
    mask: Int[np.ndarray, "N size size"]
    """0 or 1, uint8."""
    has_mask: Bool[np.ndarray, "N"]
    pose: Pose
    """Initial poses with a leading axis N, from a fit of each image to its keypoints."""
    remarks: tuple[str, ...] = ()
    """How many images of the files are not used, and why."""


def read_photographs(
    sources: Sequence[tuple[object, Observations]],
    bird: Bird,
    progress: ProgressTask = silent,
    frames_per_track: int = FRAMES_PER_TRACK,
) -> Photographs:
    """Fit the keypoints of every image by itself, and return the images with these poses.

    Args:
        sources: for each file its name in messages, and its observations. Every track is one individual.
        bird: the model to start from.
        progress: shows progress.
        frames_per_track: largest number of frames of a track that are used: frames at equal distances.

    Raises:
        InputError: no usable image, or other keypoints than the model's.
        ValueError: `frames_per_track` is below 1.
    """
    if frames_per_track < 1:
        raise ValueError(f"frames_per_track: expected 1 or more, not {frames_per_track}")
    config = _keypoint_config()
    parts: list[Photographs] = []
    remarks: list[str] = []
    for source, given in sources:
        checked = check_keypoints(given, bird.keypoint_names, source)
        observations = _few_frames(checked, config.min_keypoints, frames_per_track)
        solution = fit(observations, bird, config, progress=progress, source=source)
        usable, chosen = (int(part.usable(config.min_keypoints).sum()) for part in (checked, observations))
        all_images, fitted = int(checked.present.sum()), int(solution.valid.sum())
        remarks += _remarks(source, all_images, usable, chosen, fitted, frames_per_track)
        if fitted:
            parts.append(_images(observations, solution, source))
    if not parts:
        raise InputError(sources[0][0], "has no usable image", "annotate at least four keypoints per bird")
    first = np.cumsum([0, *(part.individual.max() + 1 for part in parts[:-1])])
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("keypoints_px", "confidence", "mask", "has_mask")
    }
    return Photographs(
        names=tuple(name for part in parts for name in part.names),
        individual=np.concatenate([part.individual + n for part, n in zip(parts, first, strict=True)]),
        **joined,
        pose=jax.tree.map(lambda *x: np.concatenate(x), *(part.pose for part in parts)),
        remarks=tuple(remarks),
    )


def _remarks(source: object, images: int, usable: int, chosen: int, fitted: int, frames_per_track: int) -> list[str]:
    """Return a sentence for each reason why images of a file are not used."""
    remarks = []
    if usable < images:
        remarks.append(f"{source}: {images - usable} of {images} images are not used: too few keypoints")
    if chosen < usable:
        why = f"at most {frames_per_track} of each track, at equal distances, because a track shows one individual"
        remarks.append(f"{source}: {chosen} of {usable} images are used: {why} (--frames-per-track)")
    if fitted < chosen:
        remarks.append(
            f"{source}: {chosen - fitted} of {chosen} images are not used: the fit of their keypoints failed"
        )
    return remarks


def _keypoint_config() -> FitConfig:
    """Return the config `photo` without its mask stage, for crops around the birds."""
    config = load_config("photo")
    stages = tuple(stage for stage in config.stages if not needs_mask(stage))
    return replace(config, stages=stages, crop=replace(config.crop, mode="box"))


def _few_frames(observations: Observations, min_keypoints: int, most: int) -> Observations:
    """Return the observations with at most `most` usable frames of each track."""
    confidence = np.array(observations.confidence)
    for n, usable in enumerate(observations.usable(min_keypoints)):
        frames = np.flatnonzero(usable)
        kept = frames[np.unique(np.linspace(0, len(frames) - 1, most).round().astype(int))] if len(frames) else []
        confidence[n, np.setdiff1d(np.arange(confidence.shape[1]), kept)] = 0
    return observations.with_keypoints(observations.keypoints_px, confidence)


def _images(observations: Observations, solution: Solution, source: object) -> Photographs:
    """Return the images of a file with a valid pose."""
    at = np.argwhere(solution.valid)
    row = {int(track): n for n, track in enumerate(observations.track_id)}
    names, points, confidence, masks = [], [], [], []
    for m, t in at.tolist():
        track, crop = int(solution.track_id[m]), solution.crops.square_px[m, t]
        n = row[track]
        mask = observations.mask(n, t)
        names.append(f"{source}: {observations.image_file(n, t) or solution.frame_index[t]}, track {track}")
        points.append(np.asarray(image_to_crop(observations.keypoints_px[n, t], crop), np.float32))
        confidence.append(observations.confidence[n, t])
        masks.append(np.zeros((MASK_PX, MASK_PX), np.uint8) if mask is None else cut_mask(mask, crop, MASK_PX))
    return Photographs(
        names=tuple(names),
        individual=np.unique(at[:, 0], return_inverse=True)[1],
        keypoints_px=np.stack(points),
        confidence=np.stack(confidence),
        mask=np.stack(masks),
        has_mask=np.any(masks, axis=(1, 2)),
        pose=jax.tree.map(lambda x: np.asarray(x)[solution.valid], solution.poses),
    )
