"""Vertex normals and the light on a mesh."""

import numpy as np
import pytest
import trimesh

from jaxfit.raster.zbuffer import shade, vertex_normals

SPHERE = trimesh.creation.icosphere(subdivisions=3)
VERTICES, FACES = np.asarray(SPHERE.vertices), np.asarray(SPHERE.faces)
GREY = np.full(VERTICES.shape, 0.6)


def test_normals_of_a_sphere_point_outwards():
    normals = vertex_normals(VERTICES * 5 + np.array([1, 2, 3]), FACES)
    assert normals.dtype == np.float32
    assert (np.sum(normals * VERTICES, 1) > 0.999).all()
    np.testing.assert_allclose(vertex_normals(VERTICES, FACES[:, ::-1]), -normals, atol=1e-6)


def test_normals_of_a_box_are_weighted_by_area():
    x, y, z = 1.0, 2.0, 3.0
    corners = np.array([[0, 0, 0], [x, 0, 0], [0, y, 0], [0, 0, z]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3]])  # the three sides that meet at a corner, half of each
    expected = -np.array([y * z, z * x, x * y])
    np.testing.assert_allclose(vertex_normals(corners, faces)[0], expected / np.linalg.norm(expected), rtol=1e-6)


def test_normals_of_a_batch_and_of_nothing():
    batch = np.stack([VERTICES, VERTICES[:, ::-1], 2 * VERTICES])
    for one, found in zip(batch, vertex_normals(batch, FACES), strict=True):
        np.testing.assert_array_equal(found, vertex_normals(one, FACES))
    lonely = np.concatenate([VERTICES, [[9, 9, 9]]])
    degenerate = np.concatenate([FACES, [[3, 3, 3]]])
    assert (vertex_normals(lonely, degenerate)[-1] == 0).all()
    assert vertex_normals(VERTICES, FACES[:0]).shape == VERTICES.shape


def test_light_falls_from_where_it_comes():
    for light in ((0, 0, -1), (3.0, 0, 0), (-0.4, -0.8, -0.6)):
        brightness = shade(VERTICES, FACES, GREY, light, ambient=0)[:, 0]
        towards = VERTICES @ np.array(light) / np.linalg.norm(light)
        np.testing.assert_allclose(brightness, 0.6 * ((1 + towards) / 2) ** 2, atol=0.01)
    sky = shade(VERTICES, FACES, GREY, ambient=1)[:, 1]
    np.testing.assert_allclose(sky, 0.6 * (3 - VERTICES[:, 1]) / 4, atol=0.01)
    both = shade(VERTICES, FACES, GREY, ambient=0.45)
    assert both.shape == VERTICES.shape
    assert 0 < both.min() < both.max() <= 0.6
    np.testing.assert_allclose(
        both, shade(VERTICES + np.array([0, 0, 9]), FACES[:, ::-1], GREY, ambient=0.45), atol=1e-6
    )


def test_wrong_arguments():
    for call, message in [
        (lambda: vertex_normals(VERTICES[:, :2], FACES), r"vertices: expected shape \(…, V, 3\)"),
        (lambda: vertex_normals(VERTICES, FACES[:, :2]), r"faces: expected shape \(F, 3\)"),
        (lambda: shade(VERTICES, FACES, GREY[:4]), "colours: expected the shape of vertices"),
        (lambda: shade(VERTICES, FACES, GREY, light=(0, 0, 0)), "light: expected a finite direction"),
        (lambda: shade(VERTICES, FACES, GREY, ambient=1.5), "ambient: expected a fraction"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
