"""Checks of labels: labels that cannot be right are named and left out of the training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.data.masks import decode_mask
from jaxfit.training.fine_tuning.labels import LabelledBird, LabelledPicture
from jaxfit.training.fine_tuning.left_right import LEAST_COMMON, mixed_up_birds
from jaxfit.training.labelled_frames import MOST_BIRDS, LabelledFrames

__all__ = ["LeftOut", "check_picture", "check_sides"]

OUTSIDE_PX = 2.0
"""Largest distance of a label outside its picture."""
MIN_AREA_PX = 30
"""Least area of a mask."""
SECOND_PART = 0.3
"""Least area of the second part of a mask of two birds, as a share of the largest part."""
PART_DISTANCE = 0.5
"""Least distance between the parts of a mask of two birds, in lengths of the largest part. A bird or a rock in front
of a bird can divide its mask, but the parts are nearer: on simulated frames, this value detects 60 % of the pairs of
birds, and 1 of 1,170 single birds."""


class LeftOut(NamedTuple):
    """A label that is not used."""

    source: Path
    picture: str
    bird: str
    """Name of the bird; empty for the whole picture."""
    problem: str

    def __str__(self) -> str:
        return f"{self.source.name}: {' '.join(filter(None, (self.picture, self.bird)))}: {self.problem}"


def check_picture(
    picture: LabelledPicture, pixels: np.ndarray | None, network: str
) -> tuple[LabelledPicture | None, list[LeftOut]]:
    """Return the picture with its usable birds, and the labels that are not used.

    A bird without a label would be trained as background. So the segmenter does not use a picture at all if one of its
    birds is not usable. The keypoint network uses the other birds of the picture.

    Args:
        picture: the labels.
        pixels: the picture; None if it cannot be read.
        network: `segmenter` or `keypoints`.

    Returns:
        The picture with its usable birds, None if it is not used; and the problems.
    """

    def left_out(problem: str, bird: str = "") -> LeftOut:
        return LeftOut(picture.source, picture.name, bird, problem)

    if pixels is None:
        return None, [left_out("the picture is missing or cannot be read")]
    size = pixels.shape[1], pixels.shape[0]
    if size != picture.size_px:
        problem = f"the picture is {size[0]}×{size[1]}, but the labels say {picture.size_px[0]}×{picture.size_px[1]}"
        return None, [left_out(problem)]
    if len(picture.birds) > MOST_BIRDS:
        return None, [left_out(f"the picture holds {len(picture.birds)} birds, more than {MOST_BIRDS}")]
    usable, problems = [], []
    for bird in picture.birds:
        problem = _problem(bird, picture.size_px, network)
        if problem is None:
            usable.append(bird)
        else:
            problems.append(left_out(problem, bird.name))
    is_used = not problems if network == "segmenter" else bool(usable)
    return (picture._replace(birds=tuple(usable)) if is_used else None), problems


def check_sides(
    pictures: Sequence[LabelledPicture], names: Sequence[str], simulated: LabelledFrames | None
) -> tuple[list[LabelledPicture], list[LeftOut]]:
    """Return the pictures without the birds whose left and right are mixed up, and these birds.

    Args:
        pictures: usable pictures.
        names: names of the keypoints.
        simulated: simulated birds for the comparison; None compares the labelled birds with each other only.
    """
    birds = [(p, bird) for p, picture in enumerate(pictures) for bird in picture.birds]
    if not birds:
        return list(pictures), []
    references_px, references_known = np.zeros((0, len(names), 2)), np.zeros((0, len(names)), bool)
    if simulated is not None:
        frames = simulated.with_keypoints(names)
        usable = frames.known.sum(-1) >= LEAST_COMMON
        references_px, references_known = frames.keypoints_px[usable], frames.known[usable]
    points = np.stack([bird.keypoints_px for _, bird in birds])
    known = np.stack([bird.visibility > 0 for _, bird in birds])
    wrong = mixed_up_birds(points, known, references_px, references_known, names)
    problem = "left and right are mixed up: the bird resembles other birds only if left and right are exchanged"
    problems = [
        LeftOut(pictures[p].source, pictures[p].name, bird.name, problem)
        for (p, bird), is_wrong in zip(birds, wrong, strict=True)
        if is_wrong
    ]
    kept: list[list[LabelledBird]] = [[] for _ in pictures]
    for (p, bird), is_wrong in zip(birds, wrong, strict=True):
        if not is_wrong:
            kept[p].append(bird)
    return [picture._replace(birds=tuple(own)) for picture, own in zip(pictures, kept, strict=True)], problems


def _problem(bird: LabelledBird, size_px: tuple[int, int], network: str) -> str | None:
    """Return why a bird cannot be used; None if it can be used."""
    (x, y, width, height), (image_width, image_height) = bird.box_px.tolist(), size_px
    if min(x, y) < -OUTSIDE_PX or x + width > image_width + OUTSIDE_PX or y + height > image_height + OUTSIDE_PX:
        return f"the box reaches outside the picture: x {x:.0f} to {x + width:.0f}, y {y:.0f} to {y + height:.0f}"
    known = bird.visibility > 0
    if network == "keypoints":
        if known.sum() < min(3, len(known)):
            return f"only {known.sum()} of the {len(known)} keypoints are labelled"
        outside = ((bird.keypoints_px < -OUTSIDE_PX) | (bird.keypoints_px > np.array(size_px) + OUTSIDE_PX)).any(-1)
        if (outside & known).any():
            x, y = bird.keypoints_px[outside & known][0].tolist()
            return f"a keypoint lies outside the picture, at x {x:.0f}, y {y:.0f}"
    if bird.mask is None:
        return "the bird has no mask" if network == "segmenter" else None
    mask = decode_mask(bird.mask)
    if mask.sum() < MIN_AREA_PX:
        return f"the mask has {mask.sum()} pixels"
    return "one mask covers two birds" if _covers_two_birds(mask) else None


def _covers_two_birds(mask: np.ndarray) -> bool:
    """Return whether a mask has two large parts that lie far from each other."""
    count, regions, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    if count < 3:
        return False
    areas = stats[1:, cv2.CC_STAT_AREA]
    largest = 1 + int(areas.argmax())
    length = stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max()
    distance = cv2.distanceTransform((regions != largest).view(np.uint8), cv2.DIST_L2, 5)
    parts = [part for part in range(1, count) if part != largest and areas[part - 1] >= SECOND_PART * areas.max()]
    return any(distance[regions == part].min() > PART_DISTANCE * length for part in parts)
