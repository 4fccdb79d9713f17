"""The renderer: pixels, overlaps and light, against its definition in NumPy and geometry done by hand."""

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
from jaxfit.raster.zbuffer import hard_mask, mask_overlap, shade, vertex_normals

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


NO_RUNS = np.zeros(0, int), np.zeros((0, 2), int)


def random_runs(rng, sizes_px, count=200):
    """Runs in any order: within a column, over many columns, empty, and to the end of the image."""
    mesh = rng.integers(0, len(sizes_px), count)
    pixels = sizes_px.prod(1)[mesh]
    first = rng.integers(0, pixels)
    length = rng.integers(0, 1 + np.minimum(pixels - first, rng.choice([1, 10, 60, 10**6], count)))
    return mesh, np.stack([first, first + length], -1)


def overlaps_agree(vertices, faces, sizes_px, mesh, runs):
    found = mask_overlap(vertices, faces, sizes_px, mesh, runs)
    for i, (width, height) in enumerate(sizes_px):
        mask = zbuffer_reference.raster(vertices[i], faces, width, height, 1)[0] >= 0
        y, x = np.nonzero(mask)
        box = [x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1] if len(x) else [0, 0, 0, 0]
        assert found.box_px[i].tolist() == box
        assert found.area_px[i] == mask.sum()
        by_column = mask.T.reshape(-1)
        for k in np.flatnonzero(mesh == i):
            assert found.shared_px[k] == by_column[runs[k, 0] : runs[k, 1]].sum()
    return found


def test_overlaps_equal_the_pixels_of_the_reference(each_isa):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        vertices, faces = np.stack([random_mesh(seed + i)[0] for i in range(4)]), random_mesh(seed)[1]
        sizes_px = np.array([[48, 48], [33, 61], [1, 70], [70, 1]])
        found = overlaps_agree(vertices, faces, sizes_px, *random_runs(rng, sizes_px))
        assert found.shared_px.any()
        assert found.area_px.all()


@pytest.mark.skipif(not ISAS, reason="built without the kernels")
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from(ISAS or ("none",)), st.sampled_from([1e-6, 1.0, 1e5, 1e20]))
def test_overlaps_of_any_mesh(seed, isa, scale):
    rng = np.random.default_rng(seed)
    vertices, faces = random_mesh(seed, faces=rng.integers(1, 40), scale=scale)
    sizes_px = rng.integers(1, 60, (1, 2))
    native.choose_isa(isa)
    try:
        overlaps_agree(vertices[None], faces, sizes_px, *random_runs(rng, sizes_px))
    finally:
        native.choose_isa("auto")


def test_a_square_at_the_borders_of_its_image(each_isa):
    moves = np.array([[0, 0], [-15, 0], [0, -15], [15, 12], [-30, 0], [30, 0], [0, 31]])
    vertices = np.stack([SQUARE + np.float32([*move, 0]) for move in moves])
    column = np.full(len(moves), 20) * 32  # the whole column at x = 20, and half of it
    mesh = np.repeat(np.arange(len(moves)), 2)
    runs = np.stack([column, column + 32, column, column + 16], -1).reshape(-1, 2)
    found = mask_overlap(vertices, HALVES, np.tile([40, 32], (len(moves), 1)), mesh, runs)
    expected = [[10, 10, 20, 20], [0, 10, 15, 20], [10, 0, 20, 15], [25, 22, 15, 10], *[[0, 0, 0, 0]] * 3]
    assert found.box_px.tolist() == expected
    assert found.area_px.tolist() == [400, 300, 300, 150, 0, 0, 0]
    assert found.shared_px.reshape(-1, 2).tolist() == [[20, 6], [0, 0], [15, 15], [0, 0], [0, 0], [0, 0], [0, 0]]


def test_edges_through_the_centres_of_pixels_belong_to_the_mask(each_isa):
    moved = SQUARE + np.float32([0.5, 0.5, 0])
    for turned in range(3):
        faces = np.roll(HALVES, turned, axis=1)
        for order in (faces, faces[:, ::-1]):
            assert mask_overlap(moved[None], order, np.array([[40, 40]]), *NO_RUNS).area_px.tolist() == [21**2]
            assert hard_mask(moved, order, 40, 40)[10:31, 10:31].sum() == 21**2


@pytest.mark.parametrize("isa", ISAS)  # the reference would need much memory
def test_a_square_that_is_drawn_in_parts(isa):
    side, width, height = 3000, 4000, 3500
    square = np.where(SQUARE == 30, np.float32(10 + side), SQUARE)
    runs = np.array([[0, width * height], [700 * height + 9, 2900 * height + 20], [3009 * height, 3010 * height]])
    native.choose_isa(isa)
    try:
        found = mask_overlap(square[None], HALVES, np.array([[width, height]]), np.zeros(3, int), runs)
        mask = hard_mask(square, HALVES, width, height)
    finally:
        native.choose_isa("auto")
    assert found.box_px.tolist() == [[10, 10, side, side]]
    assert found.area_px.tolist() == [side**2]
    assert found.shared_px.tolist() == [side**2, 2200 * side + 10, side]
    assert mask.sum() == mask[10:3010, 10:3010].sum() == side**2


def test_empty_masks(each_isa):
    broken = np.stack([np.full_like(SQUARE, value) for value in (np.nan, np.inf, -np.inf, 0)])
    sizes_px = np.tile([40, 40], (4, 1))
    whole = np.tile([0, 1600], (4, 1))
    cases = [(broken, HALVES), (np.tile(SQUARE, (4, 1, 1)), HALVES[:0]), (np.tile(SQUARE, (4, 1, 1)), [[0, 1, 1]])]
    for vertices, faces in cases:
        found = mask_overlap(vertices, np.array(faces), sizes_px, np.arange(4), whole)
        assert not any(array.any() for array in found)
    partly = np.concatenate([SQUARE, np.full((1, 3), np.nan, np.float32)])[None]
    found = mask_overlap(partly, np.concatenate([HALVES, [[2, 3, 4]]]), sizes_px[:1], *NO_RUNS)
    assert found.area_px.tolist() == [400]
    nothing = mask_overlap(np.zeros((0, 4, 3)), HALVES, np.zeros((0, 2), int), *NO_RUNS)
    assert [array.shape for array in nothing] == [(0, 4), (0,), (0,)]


def test_wrong_arguments_of_overlaps():
    def call(vertices=SQUARE[None], faces=HALVES, sizes=((40, 40),), mesh=(0,), runs=((0, 5),)):
        return mask_overlap(vertices, faces, np.array(sizes), np.array(mesh), np.array(runs))

    assert call().shared_px.tolist() == [0]
    for changed, message in [
        ({"vertices": SQUARE}, r"vertices_screen: expected shape \(B, V, 3\), got \(4, 3\)"),
        ({"faces": HALVES + 1}, r"faces: expected indices in \[0, 4\)"),
        ({"sizes": ((40, 40), (40, 40))}, r"sizes_px: expected shape \(1, 2\), got \(2, 2\)"),
        ({"sizes": ((40, 0),)}, r"sizes_px: expected integers in \[1, 16384\], got 0 to 40"),
        ({"sizes": ((40.0, 40.0),)}, "sizes_px: expected integers, got float64"),
        ({"mesh": (1,)}, r"mesh: expected integers in \[0, 0\], got 1 to 1"),
        ({"mesh": ((0,),)}, r"mesh: expected shape \(1,\), got \(1, 1\)"),
        ({"mesh": (0, 0)}, r"runs: expected shape \(2, 2\), got \(1, 2\)"),
        ({"runs": ((-1, 5),)}, "runs: expected integers in"),
        ({"runs": ((5, 4),)}, "runs: expected first pixels that are not after the ends"),
        ({"runs": ((0, 1601),)}, "runs: .* ends within the images"),
    ]:
        with pytest.raises(ValueError, match=message):
            call(**changed)


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


def test_wrong_arguments_of_shading():
    for call, message in [
        (lambda: vertex_normals(VERTICES[:, :2], FACES), r"vertices: expected shape \(…, V, 3\)"),
        (lambda: vertex_normals(VERTICES, FACES[:, :2]), r"faces: expected shape \(F, 3\)"),
        (lambda: shade(VERTICES, FACES, GREY[:4]), "colours: expected the shape of vertices"),
        (lambda: shade(VERTICES, FACES, GREY, light=(0, 0, 0)), "light: expected a finite direction"),
        (lambda: shade(VERTICES, FACES, GREY, ambient=1.5), "ambient: expected a fraction"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
