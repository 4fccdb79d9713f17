"""Checks of labels; wrong labels are named and left out.

Detection of labels whose left and right are mixed up. The keypoints of a bird form a layout. Layouts are compared after
the best similarity (position, size and rotation in the picture, no mirroring): for centred layouts a and b as complex
numbers, the distance is 1 − |⟨a, b⟩|² / (‖a‖² ‖b‖²). A bird whose left and right are exchanged resembles no other bird,
but resembles other birds once left and right are exchanged back. The reference birds are the simulated birds, whose
labels are exact, and the other labelled birds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.masks import decode_mask
from jaxfit.learning.networks.labelled_frames import MAX_BIRDS, LabelledFrames
from jaxfit.learning.networks.labels import LabelledBird, LabelledPicture

MIN_COMMON = 6
"""Least number of keypoints that two birds must share for a comparison."""
MIN_REFERENCES = 20
"""With fewer comparable birds, nothing is detected."""
NEAREST = 3
"""The distance of a bird is the mean over this number of nearest reference birds: one wrong label misleads less."""
CLEARLY_BETTER = 0.35
"""A bird counts as mixed up if the exchange reduces its distance to less than this share. On 272 simulated birds with
references of other scenes, this value detects 99.6 % of the exchanged birds, and no other bird."""


def mixed_up_birds(
    keypoints_px: Float[np.ndarray, "M K 2"],
    known: Bool[np.ndarray, "M K"],
    references_px: Float[np.ndarray, "R K 2"],
    references_known: Bool[np.ndarray, "R K"],
    names: Sequence[str],
) -> Bool[np.ndarray, "M"]:
    """Return the labelled birds whose left and right are mixed up.

    Args:
        keypoints_px: positions (x, y) of M labelled birds.
        known: whether a keypoint is labelled.
        references_px: positions of R other birds with exact labels, in any pictures.
        references_known: whether a keypoint of the other birds is known.
        names: names of the K keypoints, which tell their sides.
    """
    opposite = np.array(opposite_keypoints(names))
    M = len(keypoints_px)
    paired = (opposite >= 0) & (opposite != np.arange(len(opposite)))
    if not paired.any() or M == 0:
        return np.zeros(M, bool)
    exchange = np.where(opposite >= 0, opposite, np.arange(len(opposite)))
    layouts = np.concatenate([references_px, keypoints_px]) @ np.array([1, 1j])
    there = np.concatenate([references_known, known])
    wrong = np.zeros(M, bool)
    for m in range(M):
        both = known[m] & known[m, exchange] & paired
        if both.sum() < 2:
            continue
        others = np.arange(len(layouts)) != len(references_px) + m
        layout = keypoints_px[m] @ np.array([1, 1j])
        given = _distance(layout, known[m], layouts[others], there[others])
        exchanged = _distance(layout[exchange], known[m, exchange], layouts[others], there[others])
        if given is not None and exchanged is not None:
            wrong[m] = exchanged < CLEARLY_BETTER * given
    return wrong


def _distance(layout: np.ndarray, known: np.ndarray, others: np.ndarray, there: np.ndarray) -> float | None:
    """Return the mean distance of a layout to its nearest others; None with too few others."""
    common = known & there
    usable = common.sum(1) >= min(MIN_COMMON, known.sum())
    if usable.sum() < MIN_REFERENCES or known.sum() < 4:
        return None
    common, others = common[usable], others[usable]
    count = common.sum(1, keepdims=True)
    a, b = np.where(common, layout, 0), np.where(common, others, 0)
    a = np.where(common, a - a.sum(1, keepdims=True) / count, 0)
    b = np.where(common, b - b.sum(1, keepdims=True) / count, 0)
    norms = (np.abs(a) ** 2).sum(1) * (np.abs(b) ** 2).sum(1)
    distances = 1 - np.abs((np.conj(b) * a).sum(1)) ** 2 / np.maximum(norms, 1e-12)
    return float(np.partition(distances, NEAREST - 1)[:NEAREST].mean())


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
    if len(picture.birds) > MAX_BIRDS:
        return None, [left_out(f"the picture holds {len(picture.birds)} birds, more than {MAX_BIRDS}")]
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
        usable = frames.known.sum(-1) >= MIN_COMMON
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
