"""Boxes, areas and overlaps of masks, against the pixels of the definition in NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import random_mesh

from jaxfit.raster import kernels as native
from jaxfit.raster import zbuffer_reference
from jaxfit.raster.zbuffer import hard_mask, mask_overlap

ISAS = native.available_isas()
SQUARE = np.array([[10.0, 10, 2], [30, 10, 2], [30, 30, 2], [10, 30, 2]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
NO_RUNS = np.zeros(0, int), np.zeros((0, 2), int)


def random_runs(rng, sizes_px, count=200):
    """Runs in any order: within a column, over many columns, empty, and to the end of the image."""
    mesh = rng.integers(0, len(sizes_px), count)
    pixels = sizes_px.prod(1)[mesh]
    first = rng.integers(0, pixels)
    length = rng.integers(0, 1 + np.minimum(pixels - first, rng.choice([1, 10, 60, 10**6], count)))
    return mesh, np.stack([first, first + length], -1)


def agree(vertices, faces, sizes_px, mesh, runs):
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


def test_it_equals_the_pixels_of_the_reference(each_isa):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        vertices, faces = np.stack([random_mesh(seed + i)[0] for i in range(4)]), random_mesh(seed)[1]
        sizes_px = np.array([[48, 48], [33, 61], [1, 70], [70, 1]])
        found = agree(vertices, faces, sizes_px, *random_runs(rng, sizes_px))
        assert found.shared_px.any()
        assert found.area_px.all()


@pytest.mark.skipif(not ISAS, reason="built without the kernels")
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from(ISAS or ("none",)), st.sampled_from([1e-6, 1.0, 1e5, 1e20]))
def test_any_mesh(seed, isa, scale):
    rng = np.random.default_rng(seed)
    vertices, faces = random_mesh(seed, faces=rng.integers(1, 40), scale=scale)
    sizes_px = rng.integers(1, 60, (1, 2))
    native.choose_isa(isa)
    try:
        agree(vertices[None], faces, sizes_px, *random_runs(rng, sizes_px))
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


def test_wrong_arguments():
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
