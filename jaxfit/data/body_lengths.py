"""Lengths of the bodies of a result, relative to the model: body, wing, head with bill.

In the rest pose, keypoints and joints are linear in bone lengths and shape coefficients, so the standard deviation of a
length follows from those of the numbers of the body. Their correlations are not in a result, and are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.data.solution import Bodies
from jaxfit.model.bird import Bird

LENGTHS = {
    "length": (("bill_tip", "tail_tip"),),
    "wing": (("left_shoulder", "left_wingtip"), ("right_shoulder", "right_wingtip")),
    "head and bill": (("head", "bill_tip"),),
}
"""Name of a length → pairs of points, joints or keypoints of the model, whose mean distance it is. A model without one
of the points lacks the length."""


class BodyLength(NamedTuple):
    """A length of N birds, relative to that of the model."""

    share: Float[np.ndarray, "N"]
    """1 for the length of the model; NaN for a bird without a body."""
    sd: Float[np.ndarray, "N"]


def body_lengths(bird: Bird, bodies: Bodies) -> dict[str, BodyLength]:
    """Return the lengths of all birds, by the names in `LENGTHS`."""
    joints, parents = np.asarray(bird.joints, np.float64), np.array(bird.parents)
    to_keypoints = np.asarray(bird.keypoint_weights, np.float64)
    # a longer bone moves its joint and all that follow: (J, 3, bones)
    by_bones = np.zeros((len(joints), 3, len(joints) - 1))
    for j, parent in enumerate(parents[1:].tolist(), start=1):
        by_bones[j] = by_bones[parent]
        by_bones[j, :, j - 1] += joints[j] - joints[parent]
    by_shape = np.asarray(bird.shape_basis, np.float64)  # (S, V, 3)
    keypoint_joints = to_keypoints @ np.asarray(bird.skin_weights, np.float64)
    keypoints_by_bones = np.einsum("kj,jab->kab", keypoint_joints, by_bones)
    keypoints_by_shape = np.einsum("kv,sva->kas", to_keypoints, by_shape)
    no_shape = np.zeros((len(joints), 3, len(by_shape)))
    points = dict(zip(bird.joint_names, zip(joints, by_bones, no_shape, strict=True), strict=True))
    keypoints = zip(np.asarray(bird.keypoints, np.float64), keypoints_by_bones, keypoints_by_shape, strict=True)
    points |= dict(zip(bird.keypoint_names, keypoints, strict=True))

    mean = np.asarray(bird.bone_mean, np.float64)
    found = {}
    for name, pairs in LENGTHS.items():
        if not all(point in points for pair in pairs for point in pair):
            continue
        value, of_model = np.zeros(len(bodies.frames)), 0.0
        slopes = np.zeros((len(bodies.frames), len(mean) + len(by_shape)))
        for a, b in pairs:
            rest, bones, shape = (p - q for p, q in zip(points[a], points[b], strict=True))
            of_model += float(np.linalg.norm(rest + bones @ (mean - 1)))
            vector = rest + (bodies.bone_length - 1) @ bones.T + bodies.betas @ shape.T
            length = np.linalg.norm(vector, axis=1)
            value += length
            slopes += (vector / length[:, None]) @ np.concatenate([bones, shape], axis=1)
        sd = np.concatenate([bodies.bone_length_sd, bodies.betas_sd], axis=1)
        variance = ((slopes * sd) ** 2).sum(axis=1)
        found[name] = BodyLength(value / of_model, np.sqrt(variance) / of_model)
    return found
