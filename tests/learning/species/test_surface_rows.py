"""The comparison with a scan: no bias by noise, and weights that follow the noise."""

import numpy as np
import pytest
import trimesh

from jaxfit.learning.species.scan_fit import Linear, ModelSamples, ScanSurface, surface_rows
from jaxfit.learning.species.surface import closest_points, search_samples

NOISE, COUNT = 0.1, 1000
"""Noise of the scans of a sphere of radius 1, and number of compared points."""
BALL = trimesh.creation.icosphere(subdivisions=4)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)


@pytest.fixture(scope="module")
def sphere():
    """The sphere with the derivative of its vertices by the radius, and its visible part."""
    nothing = np.zeros((0, 3), np.float32)
    posed = Linear(VERTICES, nothing, VERTICES[..., None].astype(np.float32), nothing[..., None])
    return posed, ModelSamples.of(VERTICES, FACES, COUNT)


def noisy_scan(seed, noise=NOISE):
    """Return a scan whose points have independent noise."""
    random = np.random.default_rng(seed)
    turn = trimesh.transformations.rotation_matrix(seed + 0.4, (1, 2, 3))[:3, :3]
    scan = ScanSurface(VERTICES @ turn.T, FACES, COUNT)
    scan.points += noise * random.standard_normal(scan.points.shape)
    return scan


def test_noise_does_not_change_the_size_of_the_model(sphere):
    posed, model = sphere
    drawn, outside = [], []
    for seed in range(8):
        scan = noisy_scan(seed)
        rows = surface_rows(posed, model, scan, 2.0, 0.2, 1.0)[0]
        along = rows.weight * rows.jacobian[:, 0]
        drawn.append(-(along * rows.residual).sum() / (along * rows.jacobian[:, 0]).sum())
        closest = closest_points(scan.points, VERTICES, FACES, search_samples(VERTICES, FACES, 10_000))
        outside.append((np.linalg.norm(scan.points, axis=1) - np.linalg.norm(closest.point, axis=1)).mean())
    assert np.mean(outside) > 0.8 * NOISE**2  # the error of closest points
    assert abs(np.mean(drawn)) < 0.4 * NOISE**2


def test_the_weights_follow_the_noise_of_the_scan(sphere):
    weight = [surface_rows(*sphere, noisy_scan(0, noise), 2.0, 0.2, 1.0)[0].weight.sum() for noise in (NOISE, 0.0)]
    assert 0.4 < weight[0] * NOISE**2 < 1.0
    assert weight[1] > 5 * weight[0]
