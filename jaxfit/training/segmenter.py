"""The built-in segmenter: which pixels are bird, and towards which bird's centre each of them points.

Bottom-up instance segmentation after Panoptic-DeepLab (Cheng et al. 2020): `foreground` (logit), `centre` (a peak for
each bird) and `offset` (from a pixel to its bird's centre), which `jaxfit.perception.segmentation.bottom_up` turns into
birds.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from jaxfit.training.augment import randomise
from jaxfit.training.cuts import random_turn, surroundings
from jaxfit.training.networks import FeaturePyramid
from jaxfit.training.scenes import LabelledFrames

__all__ = ["OFFSET_UNIT_PX", "SIDE_PX", "STRIDE", "SegmenterSample", "draw_sample", "loss", "segmenter_network"]

STRIDE = 2
OFFSET_UNIT_PX = 32.0
"""What an offset of 1 means, pixels of the network's input."""
SIDE_PX = 288
"""Of the square pictures learnt from."""
PIXELS_A_UNIT = 4.2, 11.5
"""Scales learnt, pixels across 2 cm in the network's input; a ledge 2.5 m across on 864 pixels has 6.9."""
CENTRE_SIGMA = 0.14
"""Width of a centre's peak, as a share of the root of its bird's area."""
LEAST_AREA_PX = 20
"""Birds of which less is seen than this are neither learnt as birds nor as ground."""


class SegmenterSample(NamedTuple):
    """One picture and what is to be found in it, maps at a stride of 2."""

    picture: Float[np.ndarray, "3 H W"]
    """Blue, green, red within 0 and 1."""
    foreground: Float[np.ndarray, "1 h w"]
    """Share of the cell that is bird."""
    certain: Float[np.ndarray, "1 h w"]
    """1 where foreground counts, more along borders between birds; 0 where hardly anything of a bird is seen."""
    centre: Float[np.ndarray, "1 h w"]
    offset: Float[np.ndarray, "2 h w"]
    """x, y to the centre, in units of OFFSET_UNIT_PX."""
    pulls: Float[np.ndarray, "1 h w"]
    """Weight of the offset: every bird's weights have the same sum."""


def segmenter_network() -> FeaturePyramid:
    """1.5 million numbers, 3.5 billion multiplications for 864×512 pixels."""
    heads = {"foreground": 1, "centre": 1, "offset": 2}
    return FeaturePyramid((16, 32, 64, 96, 128), (0, 1, 2, 2, 2), (96, 64, 48, 24), heads)


def draw_sample(rng: np.random.Generator, frames: LabelledFrames) -> SegmenterSample:
    """A random part of a random frame at a random scale, turned, mirrored and in another light."""
    s = int(rng.integers(len(frames.pictures)))
    factor = np.exp(rng.uniform(*np.log(PIXELS_A_UNIT))) / frames.pixels_a_unit[s]
    height, width = frames.owner.shape[1:]
    middle = rng.uniform(0, [width, height])
    shown = np.flatnonzero((frames.seen[s] == 2).any(-1))
    if rng.random() < 0.85 and len(shown):
        n = rng.choice(shown)
        middle = frames.keypoints_px[s, n, frames.seen[s, n] == 2].mean(0) + rng.normal(0, 0.2 * SIDE_PX / factor, 2)
    picture, owner = _turned(rng, frames, s, middle, factor)
    picture = randomise(rng, picture, owner > 0)
    return SegmenterSample(np.moveaxis(picture, -1, 0).astype(np.float32) / 255, *_targets(owner))


def _turned(
    rng: np.random.Generator, frames: LabelledFrames, s: int, middle: np.ndarray, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """A square around `middle` at that scale, turned and perhaps mirrored: picture and owner."""
    turn, _ = random_turn(rng, factor, 15)
    # a little more than the corners of the square need
    picture, owner, low = surroundings(frames, s, middle, 0.65 * SIDE_PX / factor, factor)
    size = (SIDE_PX, SIDE_PX)
    if not owner.size:
        return np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint8)
    affine = np.column_stack([turn, SIDE_PX / 2 - turn @ (middle - low)])
    picture = cv2.warpAffine(picture, affine, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return picture, cv2.warpAffine(owner, affine, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


def _targets(owner: np.ndarray) -> tuple[np.ndarray, ...]:
    """Maps of a picture whose pixels name their bird."""
    side = SIDE_PX // STRIDE
    foreground = cv2.resize((owner > 0).astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    cells = owner[::STRIDE, ::STRIDE]
    certain, centre, pulls = np.ones((side, side), np.float32), *np.zeros((2, side, side), np.float32)
    offset = np.zeros((2, side, side), np.float32)
    at = (np.arange(side, dtype=np.float32) + 0.5) * STRIDE
    for n in np.unique(owner[owner > 0]):
        mine = cells == n
        rows, columns = np.nonzero(mine)
        area = len(rows) * STRIDE**2
        if area < LEAST_AREA_PX:
            certain[mine] = 0
            continue
        x, y = at[columns].mean(), at[rows].mean()
        sigma = max(CENTRE_SIGMA * np.sqrt(area), 2.5)
        peak = np.exp(-((at - y)[:, None] ** 2 + (at - x)[None] ** 2) / (2 * sigma**2))
        centre = np.maximum(centre, peak.astype(np.float32))
        offset[0][mine], offset[1][mine] = (x - at[columns]) / OFFSET_UNIT_PX, (y - at[rows]) / OFFSET_UNIT_PX
        pulls[mine] = 1 / len(rows)
    low = cv2.erode(cells, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    border = cv2.dilate(cells, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) != low
    certain[border & (certain > 0)] = 2
    return foreground[None], certain[None], centre[None], offset, pulls[None]


def loss(maps: dict[str, Tensor], sample: Any) -> dict[str, Tensor]:
    """The parts of the loss of a batch; their sum is what training lowers.

    Args:
        maps: the network's output.
        sample: a SegmenterSample of tensors, a batch.
    """
    logit, certain = maps["foreground"].float(), sample.certain
    entropy = functional.binary_cross_entropy_with_logits(logit, sample.foreground, certain)
    probability = torch.sigmoid(logit) * (certain > 0)
    both = (probability * sample.foreground).sum()
    dice = 1 - (2 * both + 1) / (probability.sum() + (sample.foreground * (certain > 0)).sum() + 1)
    centre = maps["centre"].float()
    peaks = ((centre - sample.centre) ** 2 * (1 + 9 * sample.centre)).mean()
    misses = (maps["offset"].float() - sample.offset).abs().sum(1, keepdim=True)
    birds = sample.pulls.sum().clamp(min=1)
    return {"foreground": 2 * entropy + dice, "centre": 60 * peaks, "offset": (misses * sample.pulls).sum() / birds}
