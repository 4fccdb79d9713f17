"""Measure masks and keypoints of birds with spread and with folded wings, on simulated scenes with known truth.

    python tests/benchmarks/wings.py --seeds 200 201 --segmenter builtin --keypoints builtin mine.onnx

The first table has the *wing recall* of a segmenter: the share of the true visible pixels of wings that lie in the mask
of the bird. The second table has the PCK@0.05 of keypoint networks (visible keypoints, relative to the longer side of
the bird's box) for true masks and for masks with errors: without the wings, shifted by 15 % of the bird's length, or
torn (35 % of the mask is missing on one side). Seeds below 500 are for tuning.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfit.data.masks import decode_mask
from jaxfit.learning.networks.augment import shifted_mask, torn_mask
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.merging import mask_iou
from jaxfit.perception.network import KeypointDetector, Segmenter, instance_of
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.raster.zbuffer import zbuffer
from jaxfit.simulation.footage import Footage, random_light
from jaxfit.simulation.scene import LEDGE_DEPTH, Scene, mesh_keypoints, stage_scene

WING_JOINTS = "shoulder", "elbow", "wrist"
SPREAD_UNITS = 17.0
"""Wings are spread if the distance of their tips in space is larger, model units; a murre's is 32 to 36 at most."""
MASK_ERRORS = "true", "without wings", "shifted", "torn"


class SeenBird(NamedTuple):
    """A bird in one frame."""

    mask: Bool[np.ndarray, "H W"]
    """Visible pixels."""
    wings: Bool[np.ndarray, "H W"]
    """Visible pixels of the wings."""
    is_spread: bool
    keypoints_px: Float[np.ndarray, "K 2"]
    visible: Bool[np.ndarray, "K"]


def filmed_birds(
    bird: Bird, scene: Scene, seed: int, every: int
) -> Iterator[tuple[UInt8[np.ndarray, "H W 3"], list[SeenBird]]]:
    """Yield every n-th picture of a scene and its birds with at least 200 visible pixels."""
    footage = Footage(bird, scene.birds, scene.view, LEDGE_DEPTH, random_light(np.random.default_rng((seed, 4))), seed)
    faces, V = np.asarray(bird.faces), len(np.asarray(bird.vertices))
    vertices = np.stack([simulated.vertices_world for simulated in scene.birds], axis=1)
    tips = [bird.keypoint_names.index(f"{side}_wingtip") for side in ("left", "right")]
    points = mesh_keypoints(bird, vertices)
    span = np.linalg.norm(points[:, :, tips[0]] - points[:, :, tips[1]], axis=-1)
    is_wing = _wing_faces(bird)
    truth, view = scene.truth, scene.view
    for t in range(0, len(vertices), every):
        screen = view.to_screen(vertices[t]).astype(np.float32)
        all_faces = np.concatenate([faces + n * V for n in range(len(screen))])
        face = zbuffer(screen.reshape(-1, 3), all_faces, view.width, view.height).face
        on_wing = (face >= 0) & is_wing[face % len(faces)]
        seen = []
        for n in range(len(screen)):
            if (n, t) not in truth.masks:
                continue
            mask = decode_mask(truth.masks[n, t])
            if mask.sum() >= 200:
                visible = (truth.confidence[n, t] > 0) & ~truth.occluded[n, t]
                is_spread = bool(span[t, n] > SPREAD_UNITS)
                seen.append(SeenBird(mask, mask & on_wing, is_spread, truth.keypoints_px[n, t], visible))
        yield footage.frame(t), seen


def _wing_faces(bird: Bird) -> Bool[np.ndarray, "F"]:
    """Return the faces that move with a wing more than with the rest of the body."""
    joints = [i for i, name in enumerate(bird.joint_names) if any(word in name for word in WING_JOINTS)]
    share = np.asarray(bird.skin_weights)[:, joints].sum(1)
    return share[np.asarray(bird.faces)].mean(1) > 0.5


def wing_recall(segmenter: Segmenter, pictures: Sequence[tuple[np.ndarray, list[SeenBird]]]) -> dict[str, float]:
    """Return the wing recall and the mean IoU of birds with spread and with folded wings; missed birds count as 0."""
    covered, total, ious = {True: 0, False: 0}, {True: 0, False: 0}, {True: [], False: []}
    for picture, birds in pictures:
        found = segmenter(picture)
        for bird in birds:
            true = instance_of(bird.mask, 1.0, "")
            assert true is not None
            iou, best = max(((mask_iou(true, other), i) for i, other in enumerate(found)), default=(0.0, -1))
            ious[bird.is_spread].append(iou)
            total[bird.is_spread] += int(bird.wings.sum())
            if iou > 0.1:
                covered[bird.is_spread] += int((found[best].whole(bird.mask.shape[::-1]) & bird.wings).sum())
    names = {True: "spread", False: "folded"}
    recall = {
        f"wing recall, {name}": covered[key] / total[key] if total[key] else np.nan for key, name in names.items()
    }
    return recall | {
        f"mean IoU, {name} ({len(ious[key])})": float(np.mean(ious[key] or [np.nan])) for key, name in names.items()
    }


def keypoint_accuracy(
    detector: KeypointDetector, pictures: Sequence[tuple[np.ndarray, list[SeenBird]]], error: str
) -> dict[str, float]:
    """Return the PCK@0.05 of visible keypoints, and the mean confidence of wrong keypoints, for one kind of masks."""
    rng = np.random.default_rng(0)
    right, confidences = {True: [], False: []}, []
    for picture, birds in pictures:
        masks = [_with_error(rng, bird, error) for bird in birds]
        pairs = [
            (bird, instance)
            for bird, mask in zip(birds, masks, strict=True)
            if (instance := instance_of(mask, 1.0, "")) is not None
        ]
        if not pairs:
            continue
        points_px, confidence = detector(picture, [instance for _, instance in pairs])
        for (bird, _), points, certainty in zip(pairs, points_px, confidence, strict=True):
            rows, columns = np.nonzero(bird.mask)
            length_px = max(np.ptp(rows), np.ptp(columns)) + 1
            error_px = np.linalg.norm(points - bird.keypoints_px, axis=-1)
            is_right = error_px < 0.05 * length_px
            right[bird.is_spread] += is_right[bird.visible].tolist()
            confidences += certainty[bird.visible & ~is_right].tolist()
    return {
        "PCK, spread": float(np.mean(right[True] or [np.nan])),
        "PCK, folded": float(np.mean(right[False] or [np.nan])),
        "confidence if wrong": float(np.mean(confidences or [np.nan])),
    }


def _with_error(rng: np.random.Generator, bird: SeenBird, error: str) -> Bool[np.ndarray, "H W"]:
    """Return the mask with an error; the true mask where little of the bird would remain."""
    if error == "true":
        return bird.mask
    if error == "without wings":
        faulty = bird.mask & ~bird.wings
    else:
        change, share = (shifted_mask, 0.15) if error == "shifted" else (torn_mask, 0.65)
        faulty = change(bird.mask, rng.uniform(0, 2 * np.pi), share)
    return faulty if faulty.sum() > 50 else bird.mask


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[200, 201])
    parser.add_argument("--segmenter", nargs="*", default=["builtin"])
    parser.add_argument("--keypoints", nargs="*", default=["builtin"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--size", type=int, nargs=2, default=(1296, 760))
    options = parser.parse_args()
    bird, pictures = load_murre(), []
    for seed in options.seeds:
        scene = stage_scene(bird, 7, options.frames, tuple(options.size), 25.0, seed)
        pictures += filmed_birds(bird, scene, seed, options.every)
    for name in options.segmenter:
        for key, value in wing_recall(load_segmenter(name), pictures).items():
            sys.stdout.write(f"{name:>30}  {key:30} {value:.3f}\n")
    for name in options.keypoints:
        detector = load_keypoint_detector(name)
        for error in MASK_ERRORS:
            values = keypoint_accuracy(detector, pictures, error)
            columns = "  ".join(f"{key} {value:.3f}" for key, value in values.items())
            sys.stdout.write(f"{name:>30}  {error:14} {columns}\n")


if __name__ == "__main__":
    main()
