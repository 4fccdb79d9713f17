"""The ground below the birds: its direction, its height, and its mesh in a glTF file."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.export.gltf_bird import body_length
from jaxfit.export.gltf_file import INDICES, VERTICES, GltfBuilder
from jaxfit.export.gltf_motion import Motion
from jaxfit.export.result import Exported

__all__ = ["Ground", "add_ground", "level_ground"]

_MARGIN = 0.5
"""Margin of the ground around the birds, as a share of their spread and of a body length."""
_FARTHEST = 5.0
"""Birds beyond this multiple of the median distance do not widen the ground: their fits are wrong."""
_BACKS = 0.1
"""Weight of the direction of the birds' backs, which decides where the lateral axes do not."""


class Ground(NamedTuple):
    """Rotation and translation from the camera frame of the image to a frame with the ground at y = 0, y up."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    low: Float[np.ndarray, "2"]
    """Smallest x and z of the ground."""
    high: Float[np.ndarray, "2"]


def level_ground(exported: Exported, motions: dict[int, Motion]) -> Ground:
    """Estimate the ground from the birds.

    The lateral axes of standing birds are level, so the upward direction n minimises Σ (n · x)² − w (n · z̄)² over the
    lateral axes x of all poses, with the mean direction z̄ of the birds' backs. The height is the median over the birds
    of the median height of their lower foot. Both are estimates: the depth of a bird is not measured.

    Args:
        exported: the result.
        motions: position of a track → its motion.
    """
    s, bird = exported.solution, exported.bird
    feet = [k for k, name in enumerate(s.keypoint_names) if "foot" in name] or list(range(len(s.keypoint_names)))
    lateral, backs, points = [], [], []
    for n, motion in motions.items():
        turn = Rotation.from_quat(motion.facing)
        body = turn * Rotation.from_rotvec(s.global_orient[n, motion.at].astype(np.float64))
        lateral.append(body.apply([1.0, 0, 0]))
        backs.append(body.apply([0, 0, 1.0]))
        relative = (s.keypoints_cam[n, motion.at] - s.transl[n, motion.at][:, None])[:, feet]
        relative = relative / s.scale[n, motion.at][:, None, None] * exported.length
        turned = np.einsum("mij,mkj->mki", turn.as_matrix(), relative.astype(np.float64))
        points.append(turned + motion.place[:, None])
    x, back = np.concatenate(lateral), np.concatenate(backs).mean(0)
    up = np.linalg.eigh(x.T @ x / len(x) - _BACKS * np.outer(back, back))[1][:, 0]
    up = up if up @ back > 0 else -up
    forward = np.array([0, 0, 1.0]) if abs(up[2]) < 0.99 else np.array([0, -1.0, 0])
    backward = -(forward - (forward @ up) * up)
    backward /= np.linalg.norm(backward)
    rotation = np.stack([np.cross(up, backward), up, backward])
    placed = [each @ rotation.T for each in points]
    height = float(np.median([np.median(each[..., 1].min(axis=1)) for each in placed]))
    flat = np.concatenate([each.reshape(-1, 3) for each in placed])[:, [0, 2]]
    distance = np.linalg.norm(np.concatenate([each.reshape(-1, 3) for each in points]), axis=1)
    flat = flat[distance <= _FARTHEST * np.median(distance)]
    low, high = flat.min(0), flat.max(0)
    margin = _MARGIN * (body_length(bird) * exported.length + float((high - low).max()))
    return Ground(rotation, np.array([0, -height, 0]), low - margin, high + margin)


def add_ground(builder: GltfBuilder, ground: Ground) -> None:
    """Add a level rectangle at y = 0."""
    (x0, z0), (x1, z1) = ground.low, ground.high
    corners = np.array([[x0, 0, z0], [x0, 0, z1], [x1, 0, z1], [x1, 0, z0]], np.float32)
    surface = {"baseColorFactor": [0.35, 0.33, 0.3, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": "ground", "pbrMetallicRoughness": surface, "doubleSided": True}
    primitive = {
        "attributes": {
            "POSITION": builder.add_array(corners, VERTICES, bounds=True),
            "NORMAL": builder.add_array(np.tile(np.array([[0, 1, 0]], np.float32), (4, 1)), VERTICES),
        },
        "indices": builder.add_array(np.array([0, 1, 2, 0, 2, 3], np.uint16), INDICES),
        "material": builder.add("materials", material),
    }
    mesh = builder.add("meshes", {"name": "ground", "primitives": [primitive]})
    builder.root["scenes"][0]["nodes"].append(builder.add("nodes", {"name": "ground", "mesh": mesh}))
