"""Random species, poses and scans with known truth: the same draws on every processor."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support.scans import small_scan

from jaxfit.model.files import load_murre
from jaxfit.simulation.species import random_pose, random_species


def rounded(covariance, seed=0):
    """Return a covariance with the relative rounding errors that another processor makes."""
    noise = np.random.default_rng(seed).standard_normal(covariance.shape)
    return np.asarray(covariance, float) * (1 + 1e-7 * (noise + noise.T))


def test_species_and_poses_do_not_depend_on_rounding():
    # covariances with equal eigenvalues have many decompositions into singular vectors
    bird = load_murre()
    other = replace(bird, pose_covariance=rounded(bird.pose_covariance), bone_covariance=rounded(bird.bone_covariance))
    pose = random_pose(bird, np.random.default_rng(0)).body_pose
    assert np.abs(random_pose(other, np.random.default_rng(0)).body_pose - pose).max() < 1e-5
    assert np.abs(random_species(other, 0).bone_mean - random_species(bird, 0).bone_mean).max() < 1e-5


def test_poses_have_the_covariance_of_the_model():
    bird = load_murre()
    random = np.random.default_rng(0)
    poses = np.stack([random_pose(bird, random, 0.5).body_pose.ravel() for _ in range(4000)])
    expected = 0.25 * np.asarray(bird.pose_covariance)
    assert np.abs(np.cov(poses.T) - expected).max() < 0.1 * expected.max()


def test_keypoints_of_a_scan_do_not_depend_on_its_number_of_vertices(monkeypatch):
    _, _, scan = small_scan()
    divide = trimesh.remesh.subdivide_to_size
    monkeypatch.setattr(trimesh.remesh, "subdivide_to_size", lambda *a, max_edge: divide(*a, max_edge=0.7 * max_edge))
    _, _, other = small_scan()
    assert len(other.vertices) != len(scan.vertices)
    assert list(other.keypoints) == list(scan.keypoints)
    for name, point in scan.keypoints.items():
        assert other.keypoints[name] == pytest.approx(point)
