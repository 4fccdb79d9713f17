"""Random meshes for the tests of the renderer."""

import numpy as np


def random_mesh(seed: int, faces: int = 40, size: int = 48, scale: float = 1.0):
    """Faces of all sizes over and around the image, some behind the camera, not finite, without area or equal."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-0.2, 1.2, (faces, 1, 2)) * size
    corners = centre + rng.normal(size=(faces, 3, 2)) * size * rng.choice([0.01, 0.05, 0.3, 2.0], (faces, 1, 1))
    corners = np.where(rng.random((faces, 1, 1)) < 0.3, np.round(corners * 2) / 2, corners)  # centres on edges
    depth = rng.uniform(0.5, 4, (faces, 3, 1)) * rng.choice([1, 1, 1, 1, 1, 1, -1, 1e-3], (faces, 3, 1))
    vertices = (np.concatenate([corners, depth], -1) * [scale, scale, 1]).reshape(-1, 3).astype(np.float32)
    vertices[rng.integers(len(vertices), size=2), rng.integers(3, size=2)] = np.nan, np.inf
    triples = np.arange(3 * faces).reshape(-1, 3)
    triples[rng.random(faces) < 0.2, 2] = 0
    same = rng.random(faces) < 0.1
    triples[same, 2] = triples[same, 1]
    return vertices, np.concatenate([triples, triples[::7, [1, 2, 0]], triples[::9, ::-1]])
