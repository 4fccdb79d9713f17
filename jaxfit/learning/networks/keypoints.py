"""The built-in keypoint network: the position of each keypoint in the crop of one bird.

The network predicts, for each keypoint, a distribution over the cells of a map and the class `absent`, whose logit is
0. Training minimises the cross-entropy to the true cell. The exported network convolves the distribution with a smooth
window, so that the height of a peak, the confidence, is the probability that the keypoint lies near the peak.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.augment import SCENE_SHARE, patch_around, random_rotation, randomise_appearance
from jaxfit.learning.networks.labelled_frames import UNKNOWN, LabelledFrames, draw_bird
from jaxfit.learning.networks.networks import FeaturePyramid, residual_stages
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception.keypoints import DILATE_PX, CropSettings
from jaxfit.perception.network import Instance, instance_of

STRIDE, SIDE_PX = 4, 192
CROPS = CropSettings(dilate_px=DILATE_PX["visible"], background="visible")
"""The crops at the paper's scale. The background is visible, so that the network sees wings that a mask lacks."""
PAPER_PIXELS_PER_UNIT = 20.7
"""The paper's scale: 2592 pixels for 2.5 m; one unit is 2 cm."""
SIGMA_CELLS = 0.9
"""Standard deviation of the target distribution. Labels are exact, but a cell is not a point."""
WINDOW_CELLS = 1.6
"""Standard deviation of the window: 6 of 192 pixels, which is 3 % of a bird that fills its crop."""
OCCLUDED_WEIGHT, ABSENT_WEIGHT = 0.5, 0.3
"""Weights in the loss of occluded keypoints and of keypoints outside the crop; visible keypoints have weight 1."""
SPREAD_SHARE = 0.2
"""Share of the samples that show a bird with spread wings, if the frames show such birds."""
UNDETECTED_SHARE = 0.1
"""Share of the neighbours that the segmenter does not detect, so that they stay visible."""
MIN_VISIBLE = 4
"""Least number of visible keypoints of a bird in the training data."""
MAX_DRAWS = 1000
"""Largest number of draws of a frame without a usable bird, so that damaged frames do not block the training."""
_opposite = cache(opposite_keypoints)


class KeypointSample(NamedTuple):
    """The crop of one bird and its keypoints."""

    picture: Float[np.ndarray, "3 H W"]
    """Blue, green, red within 0 and 1."""
    position: Float[np.ndarray, "K 2"]
    """x, y in cells of the map, cell centres at i + 0.5."""
    present: Float[np.ndarray, "K"]
    """1 if the keypoint lies in the picture, else 0."""
    weight: Float[np.ndarray, "K"]
    """Weight in the loss."""


def keypoint_network(keypoints: int = len(MURRE_KEYPOINTS)) -> FeaturePyramid:
    """Create the network, with 2 million parameters, for a number of keypoints."""
    widths = 24, 48, 80, 128, 144
    return FeaturePyramid(residual_stages(widths, (0, 1, 2, 2, 2)), widths, (112, 80, 64), {"logits": keypoints})


class KeypointMaps(nn.Module):
    """The exported network: maps whose peaks are the confidences of the keypoints."""

    window: Tensor

    def __init__(self, network: nn.Module, keypoints: int):
        super().__init__()
        self.network = network
        reach = torch.arange(-4, 5) / WINDOW_CELLS
        window = torch.exp(-0.5 * (reach[:, None] ** 2 + reach[None] ** 2))
        self.register_buffer("window", window[None, None].repeat(keypoints, 1, 1, 1), persistent=False)
        self.keypoints = keypoints

    def forward(self, pictures: Tensor) -> Tensor:
        """Compute maps (B, K, h, w) within 0 and 1 from pictures (B, 3, H, W)."""
        return self.peaks(self.network(pictures)["logits"])

    def peaks(self, logits: Tensor) -> Tensor:
        """Compute the maps from logits (B, K, h, w)."""
        # a softmax over the cells and the class `absent`, whose logit is 0
        highest = logits.amax((2, 3), keepdim=True).clamp(min=0)
        share = torch.exp(logits - highest)
        maps = share / (share.sum((2, 3), keepdim=True) + torch.exp(-highest))
        return functional.conv2d(maps, self.window, padding=4, groups=self.keypoints)


def _usable_birds(frames: LabelledFrames, s: int) -> Int[np.ndarray, "M"]:
    """Return the birds of a frame with enough visible keypoints for a sample."""
    least = min(MIN_VISIBLE, len(frames.keypoint_names))
    return np.flatnonzero((frames.visibility[s] == 2).sum(-1) >= least)


def has_usable_bird(frames: LabelledFrames) -> bool:
    """Return whether any bird of the frames has enough visible keypoints for a sample."""
    return any(len(_usable_birds(frames, s)) for s in range(len(frames.visibility)))


def draw_sample(rng: np.random.Generator, frames: LabelledFrames, scene_share: float = SCENE_SHARE) -> KeypointSample:
    """Draw a random bird of a random frame, with random rotation, mirroring, appearance and errors of the masks.

    Frames whose keypoints have no sides, such as numbers, are not mirrored.

    Args:
        rng: source of randomness.
        frames: the frames.
        scene_share: share of the samples with a random scene, as in `randomise_appearance`.

    Raises:
        InputError: none of many frames shows a bird.
    """
    for _ in range(MAX_DRAWS):
        s, n = draw_bird(rng, frames, SPREAD_SHARE)
        birds = _usable_birds(frames, s)
        if not len(birds) or (n is not None and n not in birds):
            continue
        patch = _augmented_patch(rng, frames, s, int(rng.choice(birds)) if n is None else n, scene_share)
        if patch is not None:
            return _crop_sample(rng, patch)
    raise InputError("frames", f"show no bird in {MAX_DRAWS} draws", "film the frames again")


class _Patch(NamedTuple):
    """The surroundings of a bird, with random appearance."""

    picture: np.ndarray
    birds: list[Instance]
    """The detected birds, first the bird itself."""
    points_px: np.ndarray
    visibility: np.ndarray
    relative_scale: float
    """Scale of the picture relative to the paper's footage."""


def _augmented_patch(
    rng: np.random.Generator, frames: LabelledFrames, s: int, n: int, scene_share: float
) -> _Patch | None:
    """Resample the surroundings of a bird to about the network's scale; None if too little of the bird is visible."""
    bird = instance_of(frames.owner[s] == n + 1, 1.0, "")
    if bird is None:
        return None
    h, w = bird.mask.shape
    relative_scale = frames.pixels_per_unit[s] / PAPER_PIXELS_PER_UNIT
    if max(h, w) < 30 * relative_scale:
        return None
    margin = 2 * CROPS.pad_px * relative_scale
    factor = SIDE_PX / (max(h, w) + margin) * rng.uniform(0.9, 1.1)
    centre_px = np.array([bird.x0 + w / 2, bird.y0 + h / 2])
    rotation, mirrored = random_rotation(rng, factor, 20)
    points_px, visibility = frames.keypoints_px[s, n], frames.visibility[s, n]
    opposite = np.array(_opposite(frames.keypoint_names))
    if mirrored and (opposite == np.arange(len(opposite))).all():  # the names have no sides
        rotation[:, 0] *= -1
    elif mirrored:
        points_px = points_px[opposite]
        visibility = np.where(opposite < 0, UNKNOWN, visibility[opposite]).astype(np.uint8)
    picture, owner, low = patch_around(frames, s, centre_px, 0.75 * (max(h, w) + 2 * margin), factor)
    side = int(1.5 * SIDE_PX)
    affine = np.column_stack([rotation, side / 2 - rotation @ (centre_px - low)])
    shift = affine[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts pixel centres from 0
    warp = np.column_stack([affine[:, :2], affine[:, 2] + shift])
    picture = cv2.warpAffine(picture, warp, (side, side), flags=cv2.INTER_LINEAR)
    owner = cv2.warpAffine(owner, warp, (side, side), flags=cv2.INTER_NEAREST)
    others = [k for k in np.unique(owner[owner > 0]).tolist() if k != n + 1]
    instance = instance_of(faulty_mask(rng, owner == n + 1, owner > 0), 1.0, "")
    if instance is None:
        return None
    detected = [k for k in others if rng.random() >= UNDETECTED_SHARE]
    neighbours = (instance_of(faulty_mask(rng, owner == k, owner > 0), 1.0, "") for k in detected)
    birds = [instance, *(bird for bird in neighbours if bird is not None)]
    picture = randomise_appearance(rng, picture, owner > 0, scene_share)
    points_px = (points_px - low) @ affine[:, :2].T + affine[:, 2]
    return _Patch(picture, birds, points_px, visibility, float(relative_scale * factor))


def faulty_mask(rng: np.random.Generator, mask: np.ndarray, birds: np.ndarray) -> np.ndarray:
    """Return a mask with a random error of a segmenter, one of `_MASK_ERRORS`."""
    error = str(rng.choice(list(_MASK_ERRORS), p=list(_MASK_ERRORS.values())))
    rows, columns = np.nonzero(mask)
    if error == "none" or not len(rows):
        return mask
    if error in ("eroded", "dilated"):
        change = cv2.erode if error == "eroded" else cv2.dilate
        side = int(rng.integers(2, 9))
        return change(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    if error in ("hole", "merged"):
        spot, i = np.zeros(mask.shape, np.uint8), int(rng.integers(len(rows)))
        cv2.circle(spot, (int(columns[i]), int(rows[i])), int(rng.integers(8, 30)), 1, -1)
        return mask & (spot == 0) if error == "hole" else mask | (birds & (spot > 0))
    if error == "without thin parts":
        widest = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3).max()
        side = max(int(widest * rng.uniform(0.8, 1.5)), 1)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    if error == "torn":
        along = columns * direction[0] + rows * direction[1]
        kept = along < np.quantile(along, rng.uniform(0.5, 0.9))
        torn = np.zeros_like(mask)
        torn[rows[kept], columns[kept]] = True
        return torn
    shift = rng.uniform(0, 0.15) * max(np.ptp(rows), np.ptp(columns)) * direction
    return cv2.warpAffine(mask.astype(np.uint8), np.column_stack([np.eye(2), shift]), mask.shape[::-1]) > 0


_MASK_ERRORS = {
    "none": 0.3,
    "eroded": 0.15,
    "dilated": 0.15,
    "hole": 0.08,
    "merged": 0.08,
    "without thin parts": 0.12,
    "torn": 0.07,
    "shifted": 0.05,
}
"""Errors of the masks in the training, and their shares. `merged`: with a part of a neighbour; `without thin parts`:
for example without wings; `torn`: one side is missing."""


def _crop_sample(rng: np.random.Generator, patch: _Patch) -> KeypointSample:
    """Crop the first bird of a patch as the detector does, with random margins."""
    pad, dilate = (int(px * patch.relative_scale * rng.uniform(0.4, 2.0)) for px in (CROPS.pad_px, CROPS.dilate_px))
    crops = CROPS._replace(pad_px=pad, dilate_px=dilate)
    crop_picture, crop = crops.crop(patch.picture, patch.birds, 0, (SIDE_PX, SIDE_PX))
    position, visibility = crop.to_crop(patch.points_px) / STRIDE, patch.visibility
    known = visibility != UNKNOWN
    present = known & (visibility > 0) & ((position >= 0) & (position < SIDE_PX / STRIDE)).all(-1)
    weight = known * np.where(present, np.where(visibility == 2, 1.0, OCCLUDED_WEIGHT), ABSENT_WEIGHT)
    return KeypointSample(
        np.moveaxis(crop_picture, -1, 0).astype(np.float32) / 255,
        position.astype(np.float32),
        present.astype(np.float32),
        weight.astype(np.float32),
    )


def loss(maps: dict[str, Tensor], sample: Any) -> dict[str, Tensor]:
    """Compute the cross-entropy between the predicted and the true distribution of each keypoint.

    Args:
        maps: outputs of the network.
        sample: a batch, a KeypointSample of tensors.
    """
    entropy = entropies(maps["logits"], sample)
    return {"position": (entropy * sample.weight).sum() / sample.weight.sum().clamp(min=1)}


def entropies(logits: Tensor, sample: Any) -> Tensor:
    """Return the cross-entropy of every keypoint, (B, K)."""
    logits = logits.float()
    B, K, h, w = logits.shape
    x, y = (torch.arange(side, device=logits.device) + 0.5 for side in (w, h))
    target_x = torch.exp(-0.5 * ((x - sample.position[..., :1]) / SIGMA_CELLS) ** 2)
    target_y = torch.exp(-0.5 * ((y - sample.position[..., 1:]) / SIGMA_CELLS) ** 2)
    target = (target_y[..., :, None] * target_x[..., None, :]).reshape(B, K, h * w)
    target = target / target.sum(-1, keepdim=True).clamp(min=1e-6) * sample.present[..., None]
    target = torch.cat([target, 1 - sample.present[..., None]], dim=-1)
    log_probability = functional.log_softmax(functional.pad(logits.reshape(B, K, h * w), (0, 1)), dim=-1)
    return -(target * log_probability).sum(-1)
