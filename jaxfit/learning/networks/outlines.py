"""The network that detects keypoints of any bird from its outline: simulated outlines, samples, loss, exported network.

An outline of a simulated bird looks like an outline of a photograph, which plumage and light do not. So the network
sees the mask only, and its training needs bodies and postures of many species, but no appearance.

An outline does not tell front from back: seen from far, a symmetric bird has the same outline from the direction
(x, y, z) and from (x, −y, −z), in its own axes, but left and right are exchanged. The network says with one number p
for the whole bird which of both is right. The loss of left and right keypoints is that of a mixture of both, and the
exported maps of a pair are those of the mixture: both places, with p and 1 − p.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional

from jaxfit.foundation.array_files import load_npz
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints
from jaxfit.learning.networks.keypoints import KeypointMaps, KeypointSample
from jaxfit.learning.networks.networks import FeaturePyramid, residual_stages
from jaxfit.learning.networks.varied import draw_species, log_uniform
from jaxfit.model.anatomy import AVES_KEYPOINTS, mirror_pairs
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.perception.keypoints import CropSettings, crop_outline
from jaxfit.perception.network import Instance, instance_of
from jaxfit.raster.zbuffer import hard_mask

SIDE_PX, STRIDE = 96, 4
DRAWN_PX, DRAWN_MARGIN = 128, 16
"""Side of the simulated pictures, and their margin around the bird."""
POSES = 48
"""Outlines of one species."""
NAMES = AVES_KEYPOINTS
PAIRS = mirror_pairs(NAMES)
OTHER_SIDE = np.arange(len(NAMES))
for _left, _right in PAIRS:
    OTHER_SIDE[[_left, _right]] = _right, _left


class Outlines(NamedTuple):
    """N simulated birds."""

    masks: UInt8[np.ndarray, "N bytes"]
    """Masks of DRAWN_PX × DRAWN_PX pixels, packed."""
    keypoints_px: Float[np.ndarray, "N K 2"]
    """x, y of the keypoints `NAMES`."""
    visible: UInt8[np.ndarray, "N K"]
    """0 for keypoints of parts that are cut off, under water for example."""


_WINGS = ("wing_root", "shoulder", "elbow", "wrist")
_SPREAD = tuple(name for name in POSTURES if name.startswith(("wings", "flapping")))
_FOLDED = tuple(name for name in POSTURES if name not in _SPREAD)
_DEVIATION = {
    "tail": (0.2, 0.05, 0.1),
    "lower_body": (0.1, 0.05, 0.08),
    "upper_body": (0.1, 0.05, 0.08),
    "neck_root": (0.25, 0.15, 0.3),
    "neck": (0.25, 0.15, 0.3),
    "head": (0.25, 0.15, 0.4),
    "hip": (0.3, 0.1, 0.1),
    "knee": (0.3, 0.1, 0.1),
    "ankle": (0.3, 0.1, 0.1),
    "foot": (0.3, 0.1, 0.1),
}
"""Standard deviation of the turns of joints about x, y, z, radians, in addition to the prior of the model."""
_WING_DEVIATION = 0.03, 0.25
"""The same for the joints of folded and of spread wings."""
_FLYING, _SWIMMING = 0.15, 0.15
"""Shares of the poses; all others stand."""


def draw_outlines(birds: Sequence[Bird], species: int, seed: int, progress: ProgressTask = silent) -> Outlines:
    """Draw outlines of random species in random postures and views.

    Pictures are upright: birds stand and swim with their backs up, and cameras have little roll. Flying birds are seen
    from everywhere.

    Args:
        birds: models from which the species are drawn in turn, with the keypoints `NAMES`.
        species: number of species, each with POSES outlines.
        seed: random seed.
        progress: reports every species.
    """
    parts = []
    with progress("Drawing outlines", species) as report:
        for i in range(species):
            parts.append(_outlines_of(np.random.default_rng((seed, i)), birds[i % len(birds)]))
            report(1, "")
    return Outlines(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _outlines_of(rng: np.random.Generator, bird: Bird) -> Outlines:
    """Return the outlines of one species."""
    body = _draw_body(rng, bird)
    kind = rng.choice(3, POSES, p=[1 - _FLYING - _SWIMMING, _FLYING, _SWIMMING])
    spread = (kind == 1) | ((kind == 0) & (rng.random(POSES) < 0.07))
    pose = Pose(
        global_orient=np.zeros((POSES, 3), np.float32),
        body_pose=_body_poses(rng, body, spread),
        transl=np.zeros((POSES, 3), np.float32),
        scale=np.ones(POSES, np.float32),
        bone_length=np.asarray(body.bone_mean),
        betas=np.zeros(0, np.float32),
    )
    rig = fold_bird(body)
    vertices = np.asarray(_posed(rig, pose))
    flies = kind == 1
    pitch_deg = np.where(flies, rng.normal(5, 25, POSES), rng.uniform(-15, 85, POSES))
    pitch_deg = np.where(kind == 2, rng.normal(8, 8, POSES), pitch_deg)
    roll_deg = np.where(flies, rng.normal(0, 25, POSES), rng.normal(0, 5, POSES))
    to_world = Rotation.from_euler("zxy", np.stack([rng.uniform(0, 360, POSES), pitch_deg, roll_deg], 1), degrees=True)
    vertices = vertices @ np.swapaxes(to_world.as_matrix(), 1, 2).astype(np.float32)
    points = np.asarray(body.keypoint_weights)[[body.keypoint_names.index(n) for n in NAMES]] @ vertices
    screens, points_px = _views(rng, vertices, points, flies)
    weights = np.asarray(body.skin_weights)
    legs = weights[:, [i for i, n in enumerate(body.joint_names) if n.endswith(("knee", "ankle", "foot"))]].sum(1) > 0.5
    is_leg = np.array(["foot" in name or "shin" in name for name in NAMES])
    faces, masks, visible = np.asarray(body.faces), [], np.ones((POSES, len(NAMES)), np.uint8)
    for p in range(POSES):
        hidden = np.zeros(len(weights), bool)
        if kind[p] == 2:
            low, high = np.quantile(vertices[p, ~legs, 2], [0, 1])
            level = low + rng.uniform(0.1, 0.45) * (high - low)
            hidden = vertices[p, :, 2] < level
            visible[p] = points[p, :, 2] >= level
        elif rng.random() < 0.35:  # hidden by plumage, grass or a branch
            hidden, visible[p] = legs, ~is_leg
        mask = hard_mask(screens[p].astype(np.float32), faces[~hidden[faces].any(1)], DRAWN_PX, DRAWN_PX)
        # a model has gaps between feathers, which no segmenter shows
        closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        masks.append(np.packbits(np.asarray(closed, np.uint8)))
    return Outlines(np.stack(masks), points_px.astype(np.float32), visible)


def _draw_body(rng: np.random.Generator, bird: Bird) -> Bird:
    """Draw a species. Few have a long neck, many a long tail, some a crest."""
    body = draw_species(rng, bird).body
    names, bones = body.joint_names, np.array(body.bone_mean)
    if rng.random() < 0.7:
        factor = np.exp(rng.normal(0, 0.15))
        for name in ("neck_root", "neck", "head"):
            bones[names.index(name) - 1] = np.asarray(bird.bone_mean)[names.index(name) - 1] * factor
    bones[names.index("tail") - 1] *= log_uniform(rng, 0.8, 1.5)
    vertices = np.array(body.vertices)
    if rng.random() < 0.25:
        crown = np.asarray(body.keypoint_weights)[body.keypoint_names.index("crown")] @ vertices
        size = np.ptp(vertices[:, 1])
        near = np.exp(-0.5 * (((vertices - crown) / (0.03 * size)) ** 2).sum(1, keepdims=True))
        vertices += near * size * rng.uniform(0.02, 0.09) * np.array([0, -rng.uniform(0, 1), 1])
    return dataclasses.replace(
        body, vertices=jnp.asarray(vertices, jnp.float32), bone_mean=jnp.asarray(bones, jnp.float32)
    )


_posed = jax.jit(lambda rig, pose: window_vertices(rig, window_transforms(rig, pose), pose))


def _body_poses(rng: np.random.Generator, bird: Bird, spread: np.ndarray) -> np.ndarray:
    """Draw body poses, with spread wings where it says so."""
    names = bird.joint_names[1:]
    mean = np.asarray(bird.pose_mean, np.float64).reshape(-1, 3)
    values, axes = np.linalg.eigh(np.asarray(bird.pose_covariance, np.float64))
    noise = rng.normal(size=(len(spread), len(values))) * np.sqrt(np.maximum(values, 0)) @ axes.T
    is_wing = np.array([any(part in name for part in _WINGS) for name in names])
    deviation = np.array([next((sd for n, sd in _DEVIATION.items() if name.endswith(n)), (0, 0, 0)) for name in names])
    posed = []
    for p, wings in enumerate(spread):
        base = mean.copy()
        if bird.name == "murre":
            base = POSTURES[str(rng.choice(_FOLDED))].body_pose.copy()
        elif rng.random() < 0.3:  # the trunk of a murre, with the legs of the model
            trunk = [i for i, n in enumerate(names) if n in ("lower_body", "tail", "neck_root", "neck", "head")]
            base[trunk] = POSTURES[str(rng.choice(_FOLDED))].body_pose[trunk]
        if wings:
            first, second = (POSTURES[str(n)].body_pose[is_wing] for n in rng.choice(_SPREAD, 2))
            share = rng.uniform(-0.2, 1.2)
            base[is_wing] = (first + share * (second - first)) * rng.uniform(0.5, 1.1)
        amount = rng.uniform(0, 1.5)
        turns = rng.normal(size=base.shape) * np.where(is_wing[:, None], _WING_DEVIATION[int(wings)], deviation)
        if rng.random() < 0.8:  # both sides alike, but for the gait
            for left, right in bird.bone_pairs:
                turns[right] = turns[left] * [1, -1, -1]
        posed.append(base + amount * (noise[p].reshape(-1, 3) * (0.3 if wings else 1) + turns))
    low, high = np.moveaxis(np.asarray(bird.joint_limits, np.float64), -1, 0)
    return np.clip(posed, low, high).astype(np.float32)


def _views(
    rng: np.random.Generator, vertices: np.ndarray, points: np.ndarray, flies: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project birds from random directions into pictures of DRAWN_PX; the longer side of the bird fills the picture."""
    elevation = np.where(rng.random(POSES) < 0.85, rng.normal(5, 18, POSES), rng.uniform(10, 90, POSES))
    elevation = np.where(flies & (rng.random(POSES) < 0.6), rng.uniform(-90, 50, POSES), elevation)
    e, none = np.radians(elevation), np.zeros(POSES)
    axes = np.stack(
        [
            np.stack([none + 1, none, none], 1),
            np.stack([none, -np.sin(e), -np.cos(e)], 1),
            np.stack([none, np.cos(e), -np.sin(e)], 1),
        ],
        1,
    )
    turn = Rotation.from_rotvec(rng.normal(0, np.where(flies, 0.35, 0.1))[:, None] * [0, 0, 1]).as_matrix()
    middle = (vertices.max(1, keepdims=True) + vertices.min(1, keepdims=True)) / 2
    size = np.ptp(vertices, axis=1).max(1)
    distance = size * np.exp(rng.uniform(np.log(2.5), np.log(50), POSES))
    screens = []
    for part in (vertices, points):
        cam = (part - middle) @ np.swapaxes(turn @ axes, 1, 2).astype(np.float32)
        depth = cam[..., 2] + distance[:, None].astype(np.float32)
        screens.append(np.concatenate([cam[..., :2] / depth[..., None], depth[..., None]], -1))
    low, high = screens[0][..., :2].min(1, keepdims=True), screens[0][..., :2].max(1, keepdims=True)
    zoom = (DRAWN_PX - 2 * DRAWN_MARGIN) / (high - low).max(-1, keepdims=True)
    for part in screens:
        part[..., :2] = (part[..., :2] - (low + high) / 2) * zoom + DRAWN_PX / 2
    return screens[0], screens[1][..., :2]


def load_outlines(path: Path) -> Outlines:
    """Load the outlines of a file."""
    return Outlines(**load_npz(path, {"masks": "N B", "keypoints_px": "N K 2", "visible": "N K"}))


class Scene(NamedTuple):
    """A bird as a segmenter shows it."""

    shape: tuple[int, int]
    """Height and width of the picture."""
    birds: list[Instance]
    """The bird, and another one that may hide a part of it."""
    points_px: Float[np.ndarray, "K 2"]
    visible: UInt8[np.ndarray, "K"]


def draw_scene(rng: np.random.Generator, outlines: Outlines) -> Scene:
    """Draw an outline, mirrored or not, with errors of a segmenter, cut by the picture or by another bird."""
    while True:
        scene = _draw_scene(rng, outlines)
        if scene is not None:
            return scene


def _draw_scene(rng: np.random.Generator, outlines: Outlines) -> Scene | None:
    """Draw a scene; None if too little of the bird is left."""
    n = int(rng.integers(len(outlines.masks)))
    mask, points, visible = _unpacked(outlines, n), outlines.keypoints_px[n], outlines.visible[n]
    if rng.random() < 0.5:
        mask, points = np.ascontiguousarray(mask[:, ::-1]), ([DRAWN_PX, 0] + points * [-1, 1])[OTHER_SIDE]
        visible = visible[OTHER_SIDE]
    area = mask.sum()
    # a little stretched and turned, and often at a low resolution
    zoom = log_uniform(rng, 0.15, 1.0) if rng.random() < 0.3 else 1.0
    turn = Rotation.from_rotvec([0, 0, rng.normal(0, 0.06)]).as_matrix()[:2, :2]
    linear = zoom * turn @ np.diag(np.exp(rng.normal(0, 0.05, 2)))
    side = max(int(DRAWN_PX * zoom), 16)
    shift = side / 2 - linear @ np.full(2, DRAWN_PX / 2)
    affine = np.column_stack([linear, shift + linear @ (0.5, 0.5) - 0.5])  # OpenCV counts pixel centres from 0
    mask = (cv2.warpAffine(mask * 255, affine, (side, side), flags=cv2.INTER_AREA) > 127).astype(np.uint8)
    points = points @ linear.T + shift
    if rng.random() < 0.5:
        mask = _smoothed(rng, mask)
    if rng.random() < 0.3:
        mask = keypoints.faulty_mask(rng, mask > 0, np.zeros(mask.shape, bool)).astype(np.uint8)
    if rng.random() < 0.15:  # a branch in front
        start, end = rng.uniform(0.1, 0.9, (2, 2)) * side
        thickness = max(int(side * rng.uniform(0.01, 0.06)), 1)
        away = (end - start) / max(np.linalg.norm(end - start), 1e-6) * side
        mask = cv2.line(mask, (start - away).astype(int).tolist(), (end + away).astype(int).tolist(), 0, thickness)
    masks = [mask]
    if rng.random() < 0.15:  # another bird in front
        move = np.column_stack([np.eye(2) * zoom, side * rng.uniform(0.3, 0.7, 2) * rng.choice([-1, 1], 2)])
        other = cv2.warpAffine(_unpacked(outlines, int(rng.integers(len(outlines.masks)))), move, (side, side))
        masks = [mask & (1 - other), other]
    margin = side // 2
    frame = np.array([-margin, -margin, side + margin, side + margin])
    if rng.random() < 0.15:  # the picture ends within the bird
        edge, at = int(rng.integers(4)), int(side * rng.uniform(0.15, 0.4))
        frame[edge] = at if edge < 2 else side - at
    x0, y0, x1, y1 = frame.tolist()
    rows, columns = slice(y0 + margin, y1 + margin), slice(x0 + margin, x1 + margin)
    masks = [np.pad(part, margin)[rows, columns] for part in masks]
    if masks[0].sum() < max(0.4 * area * zoom**2, 6):
        return None
    birds = [bird for part in masks if (bird := instance_of(part > 0, 1.0, "")) is not None]
    return Scene(masks[0].shape, birds, points - [x0, y0], visible)


def _unpacked(outlines: Outlines, n: int) -> np.ndarray:
    return np.unpackbits(outlines.masks[n]).reshape(DRAWN_PX, DRAWN_PX)


def draw_sample(rng: np.random.Generator, outlines: Outlines) -> KeypointSample:
    """Draw the sample of a scene."""
    scene = draw_scene(rng, outlines)
    picture, crop = crop_outline(scene.shape, scene.birds, 0, (SIDE_PX, SIDE_PX))
    position = crop.to_crop(scene.points_px) / STRIDE
    present = ((position >= 0) & (position < SIDE_PX / STRIDE)).all(-1)
    weight = np.where(present, np.where(scene.visible > 0, 1.0, keypoints.OCCLUDED_WEIGHT), keypoints.ABSENT_WEIGHT)
    return KeypointSample(
        np.moveaxis(picture, -1, 0).astype(np.float32) / 255,
        position.astype(np.float32),
        np.asarray(present, np.float32),
        weight.astype(np.float32),
    )


def _smoothed(rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
    """Return a mask without small details, a little too large or too small: the masks of networks are smooth."""
    soft = cv2.GaussianBlur(mask * 255, (0, 0), rng.uniform(0.3, 0.025 * len(mask)) + 0.01)
    return (soft > rng.uniform(70, 185)).astype(np.uint8)


CROPS = CropSettings(background="outline")


def outline_network() -> FeaturePyramid:
    """Create the network: maps of keypoints, and a map whose mean is the logit of p."""
    widths = 16, 32, 64, 128, 144
    heads = {"logits": len(NAMES), "side": 1}
    return FeaturePyramid(residual_stages(widths, (0, 0, 2, 2, 2)), widths, (96, 64, 48), heads)


def loss(maps: dict[str, Tensor], sample: Any) -> dict[str, Tensor]:
    """Compute the negative log-likelihood of the keypoints: for pairs, that of the mixture of both sides.

    Args:
        maps: outputs of the network.
        sample: a batch, a KeypointSample of tensors.
    """
    entropy = keypoints.entropies(maps["logits"], sample) * sample.weight
    other = torch.as_tensor(OTHER_SIDE, device=entropy.device)
    exchanged = KeypointSample(sample.picture, *(part[:, other] for part in sample[1:]))
    entropy_other = keypoints.entropies(maps["logits"], exchanged) * exchanged.weight
    paired = other != torch.arange(len(other), device=entropy.device)
    p = maps["side"].float().mean((1, 2, 3))
    likelihoods = torch.stack(
        [
            functional.logsigmoid(p) - entropy[:, paired].sum(1),
            functional.logsigmoid(-p) - entropy_other[:, paired].sum(1),
        ]
    )
    total = entropy[:, ~paired].sum() - torch.logsumexp(likelihoods, 0).sum()
    return {"position": total / sample.weight.sum().clamp(min=1)}


class OutlineMaps(KeypointMaps):
    """The exported network: the maps of a pair are those of the mixture of both sides."""

    other: Tensor

    def __init__(self, network: nn.Module):
        super().__init__(network, len(NAMES))
        self.register_buffer("other", torch.as_tensor(OTHER_SIDE), persistent=False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Compute maps (B, K, h, w) within 0 and 1 from pictures (B, 3, H, W), averaged over the mirror images."""
        mirrored = self._mixed(pictures.flip(3))[:, self.other].flip(3)
        return (self._mixed(pictures) + mirrored) / 2

    def _mixed(self, pictures: Tensor) -> Tensor:
        outputs = self.network(pictures)
        maps = self.peaks(outputs["logits"])
        p = torch.sigmoid(outputs["side"].mean((1, 2, 3), keepdim=True))
        return p * maps + (1 - p) * maps[:, self.other]
