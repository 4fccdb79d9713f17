"""Keypoints of simulated birds, for the check of left and right.

`python -m jaxfit.learning.networks.reference_birds` writes `reference_birds.npz`: the birds of the first 20 training
scenes. The check needs many birds, and a training begins before that many scenes are filmed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.foundation.array_files import load_npz
from jaxfit.learning.networks.labelled_frames import LabelledFrames
from jaxfit.learning.networks.scenes import simulate_ledge
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.model.files import load_murre

PATH = Path(__file__).with_name("reference_birds.npz")
SCENES = 20


def load_reference_birds() -> LabelledFrames:
    """Return one frame per bird, without pictures; a keypoint is known if it was in the picture."""
    stored = load_npz(PATH, {"keypoints": "R K 2", "known": "R K"})
    points, visibility = stored["keypoints"][:, None].astype(np.float32), stored["known"][:, None].astype(np.uint8)
    R = len(points)
    empty = np.zeros((R, 0, 0), np.uint8)
    scale = np.ones(R, np.float32)
    return LabelledFrames(np.repeat(empty[..., None], 3, -1), empty, points, visibility, scale, MURRE_KEYPOINTS)


def scene_birds(seed: int) -> tuple[Float[np.ndarray, "R K 2"], Bool[np.ndarray, "R K"]]:
    """Simulate the birds of a scene; return their keypoints, with a mean of 0 and a range of 1, and which are known."""
    scene = simulate_ledge(seed, load_murre())
    view = scene.footage.view
    points = view.to_screen(scene.keypoints[list(scene.kept)])[..., :2]
    known = np.all((points >= 0) & (points < [view.width, view.height]), axis=-1)
    points, known = points.reshape(-1, *points.shape[2:]), known.reshape(-1, known.shape[-1])
    points = points - points.mean(1, keepdims=True)
    points /= np.ptp(points, axis=1).max(-1)[:, None, None]
    return points[known.any(-1)], known[known.any(-1)]


if __name__ == "__main__":
    keypoints, known = (np.concatenate(parts) for parts in zip(*map(scene_birds, range(SCENES)), strict=True))
    np.savez_compressed(PATH, keypoints=keypoints.astype(np.float16), known=known)
