"""The built-in segmenter: foreground, centres of birds, and the offset of each pixel to the centre of its bird.

Bottom-up instance segmentation after Panoptic-DeepLab (Cheng et al. 2020). The outputs are `foreground` (logits),
`centre` (a peak for each bird) and `offset` (from a pixel to the centre of its bird).
`jaxfit.perception.segmentation` converts the outputs to instances.
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

from jaxfit.learning.networks.augment import SCENE_SHARE, patch_around, random_rotation, randomise_appearance
from jaxfit.learning.networks.labelled_frames import UNKNOWN_OWNER, LabelledFrames, draw_bird
from jaxfit.learning.networks.networks import EFFICIENTNET_WIDTHS, FeaturePyramid, efficientnet_stages

STRIDE = 2
OFFSET_UNIT_PX = 32.0
"""Length of an offset of 1, pixels of the network's input."""
SIDE_PX = 320
"""Side of the square training pictures."""
FIXED_STAGES = 3
"""Stages of the encoder, at strides 2, 4 and 8, that keep the weights of the photographs."""
ENCODER_RATE = 0.1
"""Learning rate of the other stages of the encoder, as a share of the learning rate of the top-down path."""
PIXELS_PER_UNIT = 4.2, 11.5
"""Usual range of the training scales, pixels per 2 cm in the network's input; 2.5 m over 864 pixels is 6.9."""
WIDE_PIXELS_PER_UNIT = 1.5, 15.0
"""Wide range of the training scales: forty small birds (30 pixels) to one large bird (300 pixels)."""
WIDE_SHARE = 0.5
"""Share of the samples with a scale of the wide range."""
RESAMPLING = 0.3, 1.6
"""Range of the factor between the frame and the sample; the scale of a sample may lie outside its range."""
SPREAD_SHARE = 0.3
"""Share of the samples around a bird with spread wings, if the frames show such birds."""
CENTRE_SIGMA = 0.14
"""Standard deviation of the peak at a centre, as a share of the square root of the bird's area."""
MIN_AREA_PX = 20
"""Pixels of birds with a smaller visible area are ignored in the loss."""


class SegmenterSample(NamedTuple):
    """One picture and its target maps at a stride of 2."""

    picture: Float[np.ndarray, "3 H W"]
    """Blue, green, red within 0 and 1."""
    foreground: Float[np.ndarray, "1 h w"]
    """Share of the cell that is bird."""
    foreground_weight: Float[np.ndarray, "1 h w"]
    """Weight of the foreground: 1, but 2 at borders, and 0 for birds with a small visible area."""
    centre: Float[np.ndarray, "1 h w"]
    """Peak of 1 at the centre of each bird."""
    offset: Float[np.ndarray, "2 h w"]
    """x, y to the centre of the bird, in units of OFFSET_UNIT_PX."""
    offset_weight: Float[np.ndarray, "1 h w"]
    """Weight of the offset; the weights of each bird sum to 1."""


def segmenter_network() -> FeaturePyramid:
    """Create the network, with 3.2 million parameters."""
    heads = {"foreground": 1, "centre": 1, "offset": 2}
    return FeaturePyramid(
        efficientnet_stages(), EFFICIENTNET_WIDTHS, (96, 64, 48, 24), heads, FIXED_STAGES, ENCODER_RATE
    )


def draw_sample(
    rng: np.random.Generator,
    frames: LabelledFrames,
    scene_share: float = SCENE_SHARE,
    wide_share: float = WIDE_SHARE,
) -> SegmenterSample:
    """Draw a random patch of a random frame, with random scale, rotation, mirroring and appearance.

    Args:
        rng: source of randomness.
        frames: the frames.
        scene_share: share of the samples with a random scene, as in `randomise_appearance`.
        wide_share: share of the samples with a scale of `WIDE_PIXELS_PER_UNIT`; all others have a usual scale.
    """
    s, n = draw_bird(rng, frames, SPREAD_SHARE)
    scales = WIDE_PIXELS_PER_UNIT if rng.random() < wide_share else PIXELS_PER_UNIT
    factor = np.clip(np.exp(rng.uniform(*np.log(scales))) / frames.pixels_per_unit[s], *RESAMPLING)
    height, width = frames.owner.shape[1:]
    centre_px = rng.uniform(0, [width, height])
    visible_birds = np.flatnonzero((frames.visibility[s] == 2).any(-1))
    if n is None and rng.random() < 0.85 and len(visible_birds):
        n = rng.choice(visible_birds)
    if n is not None:
        shift_px = rng.normal(0, 0.2 * SIDE_PX / factor, 2)
        centre_px = frames.keypoints_px[s, n, frames.visibility[s, n] == 2].mean(0) + shift_px
    picture, owner = _resampled_patch(rng, frames, s, centre_px, factor)
    picture = randomise_appearance(rng, picture, owner > 0, scene_share)
    return SegmenterSample(np.moveaxis(picture, -1, 0).astype(np.float32) / 255, *_targets(owner))


def _resampled_patch(
    rng: np.random.Generator, frames: LabelledFrames, s: int, centre_px: np.ndarray, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Resample a square around a point with random rotation and mirroring; return picture and bird of each pixel."""
    rotation, _ = random_rotation(rng, factor, 15)
    # the reach is slightly larger than the rotated square needs
    picture, owner, low = patch_around(frames, s, centre_px, 0.65 * SIDE_PX / factor, factor)
    size = (SIDE_PX, SIDE_PX)
    if not owner.size:
        return np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint8)
    affine = np.column_stack([rotation, SIDE_PX / 2 - rotation @ (centre_px - low)])
    picture = cv2.warpAffine(picture, affine, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return picture, cv2.warpAffine(owner, affine, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


def _targets(owner: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute the target maps from the bird of each pixel."""
    side = SIDE_PX // STRIDE
    foreground = cv2.resize((owner > 0).astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    cells = owner[::STRIDE, ::STRIDE]
    foreground_weight, centre, offset_weight = np.ones((side, side), np.float32), *np.zeros((2, side, side), np.float32)
    offset = np.zeros((2, side, side), np.float32)
    at = (np.arange(side, dtype=np.float32) + 0.5) * STRIDE
    for n in np.unique(owner[owner > 0]):
        cells_of_bird = cells == n
        if n == UNKNOWN_OWNER:
            foreground_weight[cells_of_bird] = 0
            continue
        rows, columns = np.nonzero(cells_of_bird)
        area = len(rows) * STRIDE**2
        if area < MIN_AREA_PX:
            foreground_weight[cells_of_bird] = 0
            continue
        x, y = at[columns].mean(), at[rows].mean()
        sigma = max(CENTRE_SIGMA * np.sqrt(area), 2.5)
        peak = np.exp(-((at - y)[:, None] ** 2 + (at - x)[None] ** 2) / (2 * sigma**2))
        centre = np.maximum(centre, peak.astype(np.float32))
        offset[0][cells_of_bird], offset[1][cells_of_bird] = (
            (x - at[columns]) / OFFSET_UNIT_PX,
            (y - at[rows]) / OFFSET_UNIT_PX,
        )
        offset_weight[cells_of_bird] = 1 / len(rows)
    low = cv2.erode(cells, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    border = cv2.dilate(cells, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) != low
    foreground_weight[border & (foreground_weight > 0)] = 2
    return foreground[None], foreground_weight[None], centre[None], offset, offset_weight[None]


def loss(maps: dict[str, Tensor], sample: Any) -> dict[str, Tensor]:
    """Compute the terms of the loss of a batch; training minimises their sum.

    Args:
        maps: outputs of the network.
        sample: a batch, a SegmenterSample of tensors.
    """
    logit, weight = maps["foreground"].float(), sample.foreground_weight
    entropy = functional.binary_cross_entropy_with_logits(logit, sample.foreground, weight)
    probability = torch.sigmoid(logit) * (weight > 0)
    intersection = (probability * sample.foreground).sum()
    dice = 1 - (2 * intersection + 1) / (probability.sum() + (sample.foreground * (weight > 0)).sum() + 1)
    centre = maps["centre"].float()
    centre_error = ((centre - sample.centre) ** 2 * (1 + 9 * sample.centre)).mean()
    offset_error = (maps["offset"].float() - sample.offset).abs().sum(1, keepdim=True)
    birds = sample.offset_weight.sum().clamp(min=1)
    return {
        "foreground": 2 * entropy + dice,
        "centre": 60 * centre_error,
        "offset": (offset_error * sample.offset_weight).sum() / birds,
    }
