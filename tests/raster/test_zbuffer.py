"""The z-buffer renderer: against its definition in NumPy, and against geometry done by hand."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import random_mesh

from jaxfit.raster import kernels as native
from jaxfit.raster import zbuffer as render
from jaxfit.raster import zbuffer_reference

ISAS = native.available_isas()
needs_kernels = pytest.mark.skipif(not ISAS, reason="built without the kernels")
SQUARE = np.array([[10.0, 10, 2], [30, 10, 2], [30, 30, 2], [10, 30, 2]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def agree(vertices, faces, width, height, samples=2):
    """Every kernel equals the reference."""
    rng = np.random.default_rng(0)
    found, expected = (
        render.zbuffer(vertices, faces, width, height),
        zbuffer_reference.fragments(vertices, faces, width, height),
    )
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(render.hard_mask(vertices, faces, width, height), expected[0] >= 0)
    attributes = rng.normal(size=(len(vertices), 5)).astype(np.float32)
    found = render.interpolate(vertices, faces, attributes, width, height, samples)
    expected = zbuffer_reference.interpolate(vertices, faces, attributes, width, height, samples)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_array_equal(found[1], expected[1].astype(np.float32))
    np.testing.assert_array_equal(found[2], expected[2])
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    drawn, colours = image.copy(), rng.uniform(-0.2, 1.2, (len(vertices), 3)).astype(np.float32)
    zbuffer_reference.draw(drawn, vertices, faces, colours, samples)
    np.testing.assert_array_equal(render.draw(image, vertices, faces, colours, samples), drawn)


def test_the_kernels_equal_the_reference(each_isa):
    for seed, width, height, samples in [(0, 48, 48, 2), (1, 33, 61, 3), (2, 1, 70, 8)]:
        agree(*random_mesh(seed), width, height, samples)


@needs_kernels
@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from(ISAS or ("none",)), st.sampled_from([1e-6, 1.0, 1e5, 1e20]))
def test_any_mesh(seed, isa, scale):
    native.choose_isa(isa)
    try:
        agree(*random_mesh(seed, scale=scale), 40, 50)
    finally:
        native.choose_isa("auto")


def test_strips_and_tiles_join(each_isa):
    vertices, faces = random_mesh(3, faces=60, size=300)
    whole = render.zbuffer(vertices, faces, 300, 400)  # many strips
    for top, left in ((0, 0), (130, 77), (251, 199)):
        corner = (vertices - np.array([left, top, 0], np.float32)).astype(np.float32)
        part = render.zbuffer(corner, faces, 60, 50)
        same = part.face == whole.face[top : top + 50, left : left + 60]
        assert same.mean() > 0.999  # moved coordinates are rounded anew


def test_a_batch_is_its_images(each_isa):
    meshes = [random_mesh(seed)[0] for seed in range(6)]
    faces = random_mesh(0)[1]
    vertices = np.stack(meshes).reshape(2, 3, -1, 3)
    attributes = np.random.default_rng(0).random((2, 3, vertices.shape[-2], 2)).astype(np.float32)
    together = render.zbuffer(vertices, faces, 40, 30)
    assert together.barycentric.shape == (2, 3, 30, 40, 3)
    mixed = render.interpolate(vertices, faces, attributes, 40, 30)
    shared = render.interpolate(vertices, faces, attributes[0, 0], 40, 30)
    for i in np.ndindex(2, 3):
        for a, b in zip(together, render.zbuffer(vertices[i], faces, 40, 30), strict=True):
            np.testing.assert_array_equal(a[i], b)
        for a, b in zip(mixed, render.interpolate(vertices[i], faces, attributes[i], 40, 30), strict=True):
            np.testing.assert_array_equal(a[i], b)
        one = render.interpolate(vertices[i], faces, attributes[0, 0], 40, 30)
        np.testing.assert_array_equal(shared[0][i], one[0])
    empty = render.zbuffer(vertices[:0], faces, 40, 30)
    assert empty.face.shape == (0, 3, 30, 40)
    nothing = render.interpolate(np.zeros((0, 3)), faces[:0], np.zeros((0, 2)), 40, 30)
    assert [a.shape for a in nothing] == [(30, 40, 2), (30, 40), (30, 40)]
    assert not nothing[1].any()


def test_shared_edges_have_no_holes(each_isa):
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(3, 37, 12), np.linspace(2, 41, 14))
    inner = (x > 3) & (x < 37) & (y > 2) & (y < 41)
    for moved in (0.0, 0.9):
        jitter = moved * rng.uniform(-1, 1, (2, *x.shape)) * inner
        vertices = np.stack([x + jitter[0], y + jitter[1], np.full(x.shape, 3.0)], -1).reshape(-1, 3)
        a = (np.arange(13)[:, None] * 12 + np.arange(11)).reshape(-1, 1)
        faces = np.concatenate([a + np.array([0, 1, 12]), a + np.array([13, 12, 1])])
        covered = np.zeros((50, 45), bool)
        covered[2:41, 3:37] = True
        np.testing.assert_array_equal(render.hard_mask(vertices, faces, 45, 50), covered)
        once = sum(render.hard_mask(vertices, faces[i : i + 1], 45, 50).astype(int) for i in range(len(faces)))
        assert (once[covered] > 1).mean() < (0.2 if moved == 0 else 0.01)  # twice on edges only
        depth = render.zbuffer(vertices, faces, 45, 50).depth
        np.testing.assert_array_equal(depth, np.where(covered, 3, np.inf).astype(np.float32))


def test_equal_depths_go_to_the_first_face(each_isa):
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 2, 3]])
    for order in (faces, faces[::-1]):
        face = render.zbuffer(SQUARE, order, 40, 40).face[10:30, 10:30]
        below = np.tril(np.ones((20, 20), bool), -1)
        whole = np.flatnonzero((order == [0, 2, 3]).all(1))[0]
        assert (face[below] == whole).all()
        assert (face[~below & ~np.eye(20, dtype=bool)] == (1 if whole == 0 else 0)).all()
        assert (face[np.eye(20, dtype=bool)] == 0).all()  # centres on the shared edge


def test_a_plane_in_perspective(each_isa):
    focal, centre = 60.0, 24.0
    corners = np.array([[-4.0, -3, 4], [5, -3, 6], [5, 4, 12], [-4, 4, 9.5]])
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    corners[2, 2] = (normal @ corners[0] - normal[:2] @ corners[2, :2]) / normal[2]  # the fourth on the plane
    screen = np.concatenate([focal * corners[:, :2] / corners[:, 2:] + centre, corners[:, 2:]], 1)
    seen = render.zbuffer(screen, HALVES, 48, 48)
    row, column = np.nonzero(seen.face >= 0)
    assert len(row) > 500
    ray = np.stack([(column + 0.5 - centre) / focal, (row + 0.5 - centre) / focal, np.ones(len(row))], 1)
    depth = (normal @ corners[0]) / (ray @ normal)
    np.testing.assert_allclose(seen.depth[row, column], depth, rtol=1e-5)
    weights = seen.barycentric[row, column]
    point = np.einsum("nk,nkc->nc", weights, corners[HALVES[seen.face[row, column]]])
    np.testing.assert_allclose(point, ray * depth[:, None], atol=1e-4)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    values, coverage, _ = render.interpolate(screen, HALVES, corners.astype(np.float32), 48, 48, 1)
    np.testing.assert_array_equal(coverage > 0, seen.face >= 0)
    np.testing.assert_allclose(values[row, column], point, atol=1e-4)


def test_coverage_is_the_area(each_isa):
    triangle = np.array([[3.3, 4.1, 1], [55.2, 17.7, 2], [21.9, 60.4, 3]])
    (ax, ay), (bx, by) = triangle[1, :2] - triangle[0, :2], triangle[2, :2] - triangle[0, :2]
    area = abs(ax * by - ay * bx) / 2
    ones = np.ones((3, 1))
    for samples, tolerance in ((1, 0.01), (4, 0.002)):
        values, coverage, face = render.interpolate(triangle, np.array([[0, 1, 2]]), ones, 64, 64, samples)
        assert coverage.sum() == pytest.approx(area, rel=tolerance)
        np.testing.assert_allclose(values[..., 0], coverage, atol=1e-6)  # premultiplied
        np.testing.assert_array_equal(face >= 0, coverage > 0)
    edge = np.array([[10.25, 0, 1], [90, 0, 1], [90, 64, 1], [10.25, 64, 1]])
    _, coverage, _ = render.interpolate(edge, HALVES, np.ones((4, 1)), 64, 64, 4)
    np.testing.assert_array_equal(coverage[:, :12], np.tile([0] * 10 + [0.75, 1], (64, 1)))


def test_faces_that_intersect(each_isa):
    """Two squares, tilted against one another, meet at x = 20 and change places there."""
    other = SQUARE.copy()
    other[[0, 3], 2], other[[1, 2], 2] = 1, 3
    depth_at = 1 / (1 + (np.arange(10, 30) + 0.5 - 10) / 20 * (1 / 3 - 1))
    vertices, faces = np.concatenate([SQUARE, other]), np.concatenate([HALVES, HALVES + 4])
    seen = render.zbuffer(vertices, faces, 40, 40)
    np.testing.assert_allclose(seen.depth[15, 10:30], np.minimum(depth_at, 2), rtol=1e-6)
    np.testing.assert_array_equal(seen.face[15, 10:30] >= 2, depth_at < 2)


def test_skipped_faces(each_isa):
    one = np.array([[0, 1, 2]])
    visible = SQUARE[:3]
    assert render.hard_mask(visible, one, 40, 40).sum() == 210  # a half with its diagonal
    cases = {"no faces": (visible, one[:0]), "outside": (visible + np.float32([100, 0, 0]), one)}
    cases["no area"] = (visible, np.array([[0, 1, 1], [2, 2, 2]]))
    cases["a line"] = (np.float32([[1, 1, 1], [20, 20, 1], [30, 30, 1]]), one)
    for depth in (0.0, -1.0, 1e-3, np.nan, np.inf):
        moved = visible.copy()
        moved[1, 2] = depth
        cases[f"depth {depth}"] = moved, one
    for value in (np.nan, np.inf, -np.inf):
        moved = visible.copy()
        moved[2, 1] = value
        cases[f"y {value}"] = moved, one
    for name, (vertices, faces) in cases.items():
        assert not render.hard_mask(vertices, faces, 40, 40).any(), name
        seen = render.zbuffer(vertices, faces, 40, 40)
        assert (seen.face == -1).all(), name
        assert (seen.depth == np.inf).all(), name
        assert (seen.barycentric == 0).all(), name
        image = np.full((40, 40, 3), 7, np.uint8)
        np.testing.assert_array_equal(render.draw(image, vertices, faces, np.ones((len(vertices), 3))), image)
    beyond = visible.copy()
    beyond[1, 2] = 1.001e-3
    assert render.hard_mask(beyond, one, 40, 40).any()
    broken = np.concatenate([visible, np.full((1, 3), np.nan, np.float32)])
    assert render.hard_mask(broken, np.array([[0, 1, 2], [1, 2, 3]]), 40, 40).sum() == 210


def test_drawing(each_isa):
    image = np.full((40, 40, 3), 100, np.uint8)
    colours = np.tile([1.0, 0.5, 0.0], (4, 1))
    square = SQUARE + np.float32([0.5, 0, 0])
    drawn = render.draw(image[:, ::-1], square, HALVES, colours, 2)
    assert (image == 100).all()
    assert drawn[20, 20].tolist() == [255, 128, 0]
    assert drawn[20, 10].tolist() == drawn[20, 30].tolist() == [178, 114, 50]  # half covered
    untouched = np.ones((40, 40), bool)
    untouched[10:30, 10:31] = False
    assert (drawn[untouched] == 100).all()


def test_masks_are_what_lies_inside_a_face(each_isa):
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=12.3)
    mask = render.hard_mask(np.asarray(sphere.vertices) + np.array([20, 18, 50]), sphere.faces, 40, 37)
    y, x = np.mgrid[:37, :40] + 0.5
    outline = np.hypot(x - 20, y - 18)
    assert mask[outline < 12.1].all()
    assert not mask[outline > 12.3].any()


def test_wrong_arguments():
    good, image, colours = SQUARE, np.zeros((40, 40, 3), np.uint8), np.ones((4, 3))
    for call, message in [
        (lambda: render.zbuffer(good[:, :2], HALVES, 40, 40), r"vertices_screen: expected shape \(…, V, 3\)"),
        (lambda: render.zbuffer(good.astype(int), HALVES, 40, 40), "vertices_screen: expected floats"),
        (lambda: render.zbuffer(good, HALVES[0], 40, 40), r"faces: expected shape \(F, 3\)"),
        (lambda: render.zbuffer(good, HALVES.astype(float), 40, 40), "faces: expected integers"),
        (lambda: render.zbuffer(good, HALVES + 1, 40, 40), r"faces: expected indices in \[0, 4\), got 1 to 4"),
        (lambda: render.zbuffer(good, HALVES - 1, 40, 40), "faces: expected indices"),
        (lambda: render.zbuffer(good, HALVES, 0, 40), "width: expected an integer from 1"),
        (lambda: render.hard_mask(good, HALVES, 40, 40.0), "height: expected an integer"),
        (lambda: render.interpolate(good, HALVES, colours[:3], 40, 40), r"attributes: expected shape \(4, channels\)"),
        (lambda: render.interpolate(good, HALVES, colours, 40, 40, 9), "samples: expected an integer from 1 to 8"),
        (lambda: render.draw(image / 255, good, HALVES, colours), "image: expected uint8 of shape"),
        (lambda: render.draw(image[..., 0], good, HALVES, colours), "image: expected uint8 of shape"),
        (lambda: render.draw(image, good, HALVES, colours[:, :2]), r"colours: expected shape \(4, 3\)"),
        (lambda: render.draw(image, good[None], HALVES, colours), r"vertices_screen: expected shape \(V, 3\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


def test_without_kernels_a_process_of_its_own_renders_and_says_so():
    code = "import numpy as np; from jaxfit.raster import zbuffer as render\n"
    code += "v = np.float32([[2, 2, 1], [12, 3, 1], [6, 13, 1]])\n"
    code += "for _ in range(2): m = render.hard_mask(v, np.array([[0, 1, 2]]), 16, 16)\nprint(m.sum())"
    environment = os.environ | {native.ISA_VARIABLE: "none"}
    found = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, cwd=Path.cwd()
    )
    corners = np.float32([[2, 2, 1], [12, 3, 1], [6, 13, 1]])
    expected = zbuffer_reference.raster(corners, np.array([[0, 1, 2]]), 16, 16, 1)
    assert int(found.stdout) == (expected[0] >= 0).sum()
    assert found.stderr.count("renderings in NumPy") == 1


def test_a_batch_of_masks_equals_single_masks():
    rng = np.random.default_rng(3)
    vertices = np.concatenate([rng.uniform(-5, 50, (2, 3, 8, 2)), rng.uniform(1, 2, (2, 3, 8, 1))], -1)
    faces = rng.integers(0, 8, (5, 3))
    masks = render.hard_mask(vertices, faces, 40, 30)
    assert masks.shape == (2, 3, 30, 40)
    for at in np.ndindex(2, 3):
        np.testing.assert_array_equal(masks[at], render.hard_mask(vertices[at], faces, 40, 30))
