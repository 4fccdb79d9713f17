"""The built-in keypoint network: for one bird on black, where each keypoint is, or that it is nowhere.

Every keypoint has a distribution over the cells of its map and one more place, `nowhere`, whose logit is 0. Training
lowers the cross-entropy to the true place. What is exported sums that distribution around every cell with a smooth
window, so that a peak's height is the probability that the keypoint lies near it: a confidence that means something.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from jaxfit.model.anatomy import MURRE_KEYPOINTS, other_side
from jaxfit.perception.instances import Instance, instance_of
from jaxfit.perception.keypoints.crops import DILATE_PX, PAD_PX, crop_bird
from jaxfit.training.augment import randomise
from jaxfit.training.cuts import random_turn, surroundings
from jaxfit.training.networks import FeaturePyramid
from jaxfit.training.scenes import LabelledFrames

__all__ = ["SIDE_PX", "STRIDE", "KeypointSample", "Peaks", "draw_sample", "keypoint_network", "loss"]

STRIDE, SIDE_PX = 4, 192
PAPER_PIXELS_A_UNIT = 20.7
"""Scale of the footage for which the crop's margins, PAD_PX and DILATE_PX, are meant: 2592 pixels across 2.5 m."""
SIGMA_CELLS = 0.9
"""Width of the true place: labels are exact, but a cell is not a point."""
WINDOW_CELLS = 1.6
"""Width of the window that sums the distribution: 6 of 192 pixels, 3 % of a bird that fills its crop."""
HIDDEN_WEIGHT, NOWHERE_WEIGHT = 0.5, 0.3
LEAST_SEEN = 4
"""Fewest visible keypoints of a bird to learn from."""
_MIRRORED = [MURRE_KEYPOINTS.index(other_side(name)) for name in MURRE_KEYPOINTS]


class KeypointSample(NamedTuple):
    """One bird and its keypoints."""

    picture: Float[np.ndarray, "3 H W"]
    """Blue, green, red within 0 and 1."""
    place: Float[np.ndarray, "K 2"]
    """x, y in cells of the map, cell centres at i + 0.5."""
    present: Float[np.ndarray, "K"]
    """1 where that place lies in the picture, 0 for nowhere."""
    weight: Float[np.ndarray, "K"]


def keypoint_network() -> FeaturePyramid:
    """2 million numbers."""
    heads = {"logits": len(MURRE_KEYPOINTS)}
    return FeaturePyramid((24, 48, 80, 128, 144), (0, 1, 2, 2, 2), (112, 80, 64), heads)


class Peaks(nn.Module):
    """The network as it is exported: maps of probabilities whose peaks are confidences."""

    def __init__(self, network: nn.Module, keypoints: int):
        super().__init__()
        self.network = network
        reach = torch.arange(-4, 5) / WINDOW_CELLS
        window = torch.exp(-0.5 * (reach[:, None] ** 2 + reach[None] ** 2))
        self.window = window[None, None].repeat(keypoints, 1, 1, 1)
        self.keypoints = keypoints

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W) → (B, K, h, w) within 0 and 1."""
        logits = self.network(pictures)["logits"]
        B, K, h, w = logits.shape
        flat = functional.pad(logits.reshape(B, K, h * w), (0, 1))  # the last place is nowhere
        maps = torch.softmax(flat, dim=-1)[..., :-1].reshape(B, K, h, w)
        return functional.conv2d(maps, self.window, padding=4, groups=self.keypoints)


def draw_sample(rng: np.random.Generator, frames: LabelledFrames) -> KeypointSample:
    """A random bird of a random frame: turned, mirrored, in another light, cut by a faulty mask."""
    while True:
        s = int(rng.integers(len(frames.pictures)))
        birds = np.flatnonzero((frames.seen[s] == 2).sum(-1) >= LEAST_SEEN)
        if not len(birds):
            continue
        found = _turned(rng, frames, s, int(rng.choice(birds)))
        if found is not None:
            return _cut(rng, *found)


def _turned(
    rng: np.random.Generator, frames: LabelledFrames, s: int, n: int
) -> tuple[np.ndarray, Instance, np.ndarray, np.ndarray, float] | None:
    """The bird's surroundings at about the network's scale; None where too little of it is seen.

    Returns:
        Picture in another light, the bird, its keypoints in pixels, whether each is seen, and pixels of the paper's
        footage for one of these.
    """
    bird = instance_of(frames.owner[s] == n + 1, 1.0, "")
    if bird is None:
        return None
    h, w = bird.mask.shape
    one = frames.pixels_a_unit[s] / PAPER_PIXELS_A_UNIT
    if max(h, w) < 30 * one:
        return None
    margin = 2 * PAD_PX * one
    factor = SIDE_PX / (max(h, w) + margin) * rng.uniform(0.9, 1.1)
    middle = np.array([bird.x0 + w / 2, bird.y0 + h / 2])
    turn, mirrored = random_turn(rng, factor, 20)
    points, seen = frames.keypoints_px[s, n], frames.seen[s, n]
    if mirrored:
        points, seen = points[_MIRRORED], seen[_MIRRORED]
    picture, owner, low = surroundings(frames, s, middle, 0.75 * (max(h, w) + 2 * margin), factor)
    side = int(1.5 * SIDE_PX)
    affine = np.column_stack([turn, side / 2 - turn @ (middle - low)])
    shift = affine[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts pixel centres from 0
    warp = np.column_stack([affine[:, :2], affine[:, 2] + shift])
    picture = cv2.warpAffine(picture, warp, (side, side), flags=cv2.INTER_LINEAR)
    owner = cv2.warpAffine(owner, warp, (side, side), flags=cv2.INTER_NEAREST)
    found = instance_of(_faulty(rng, owner == n + 1, owner > 0), 1.0, "")
    if found is None:
        return None
    picture = randomise(rng, picture, owner > 0)
    return picture, found, (points - low) @ affine[:, :2].T + affine[:, 2], seen, float(one * factor)


def _faulty(rng: np.random.Generator, mask: np.ndarray, birds: np.ndarray) -> np.ndarray:
    """The mask as a segmenter may give it: worn or grown, with a part missing, or with some of a neighbour."""
    kind = rng.random()
    side = int(rng.integers(2, 9))
    if kind < 0.25:
        return cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    if kind < 0.5:
        return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    if kind < 0.7:
        rows, columns = np.nonzero(mask)
        if not len(rows):
            return mask
        spot, i = np.zeros(mask.shape, np.uint8), int(rng.integers(len(rows)))
        cv2.circle(spot, (int(columns[i]), int(rows[i])), int(rng.integers(8, 30)), 1, -1)
        return mask & (spot == 0) if kind < 0.6 else mask | (birds & (spot > 0))
    return mask


def _cut(
    rng: np.random.Generator, picture: np.ndarray, bird: Instance, points: np.ndarray, seen: np.ndarray, one: float
) -> KeypointSample:
    """The crop that the detector would make of this bird, with margins between narrow and wide."""
    pad, dilate = (int(margin * one * rng.uniform(0.4, 2.0)) for margin in (PAD_PX, DILATE_PX))
    alone, crop = crop_bird(picture, bird, (SIDE_PX, SIDE_PX), pad, max(dilate, 2))
    place = crop.to_crop(points) / STRIDE
    present = (seen > 0) & ((place >= 0) & (place < SIDE_PX / STRIDE)).all(-1)
    weight = np.where(present, np.where(seen == 2, 1.0, HIDDEN_WEIGHT), NOWHERE_WEIGHT)
    return KeypointSample(
        np.moveaxis(alone, -1, 0).astype(np.float32) / 255,
        place.astype(np.float32),
        present.astype(np.float32),
        weight.astype(np.float32),
    )


def loss(maps: dict[str, Tensor], sample: Any) -> dict[str, Tensor]:
    """Cross-entropy between where the network expects each keypoint and where it is.

    Args:
        maps: the network's output.
        sample: a KeypointSample of tensors, a batch.
    """
    logits = maps["logits"].float()
    B, K, h, w = logits.shape
    x, y = (torch.arange(side, device=logits.device) + 0.5 for side in (w, h))
    across = torch.exp(-0.5 * ((x - sample.place[..., :1]) / SIGMA_CELLS) ** 2)
    down = torch.exp(-0.5 * ((y - sample.place[..., 1:]) / SIGMA_CELLS) ** 2)
    target = (down[..., :, None] * across[..., None, :]).reshape(B, K, h * w)
    target = target / target.sum(-1, keepdim=True).clamp(min=1e-6) * sample.present[..., None]
    target = torch.cat([target, 1 - sample.present[..., None]], dim=-1)
    expected = functional.log_softmax(functional.pad(logits.reshape(B, K, h * w), (0, 1)), dim=-1)
    entropy = -(target * expected).sum(-1)
    return {"place": (entropy * sample.weight).sum() / sample.weight.sum()}
