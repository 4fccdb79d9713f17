"""Sides and IoU from meshes and runs equal those of masks of whole images."""

import dataclasses
import itertools

import numpy as np
import pytest
from support.evaluated import BIRD, HEIGHT, WIDTH, N, T, known, longest_side_of_mask, solution, truth

from jaxfit.data import mask_comparison
from jaxfit.data.mask_comparison import compare_masks
from jaxfit.data.masks import decode_mask, encode_mask
from jaxfit.data.projection import PosedBirds
from jaxfit.evaluation.metrics import iou
from jaxfit.foundation.progress import silent
from jaxfit.raster.zbuffer import hard_mask

AT = np.arange(N)[:, None], np.arange(T)


def by_whole_images(result, seen, measured):
    """Return the three arrays from masks of whole images."""
    posed = PosedBirds(result, BIRD)
    expected = np.full((3, N, T), np.nan)
    for n, t in np.argwhere(measured).tolist():
        drawn = hard_mask(posed.vertices_screen(n, t), np.asarray(posed.faces), *seen.image_size(n, t))
        expected[2, n, t] = longest_side_of_mask(drawn)
        true = seen.whole_mask(n, t)
        if true is None:
            expected[1, n, t] = seen.box_px[n, t, 2:].max()
            continue
        expected[1, n, t] = longest_side_of_mask(true)
        if (n, t) not in seen.amodal_masks and (n, t) not in seen.own_images:
            for other in range(N):
                if other != n and (other, t) in seen.masks and (other, t) not in seen.own_images:
                    drawn &= true | ~decode_mask(seen.masks[other, t])
        expected[0, n, t] = iou(drawn, true)
    return expected


def random_masks(seed):
    rng = np.random.default_rng(seed)
    masks = {}
    for n in range(N):
        for t in range(T):
            rough = rng.random((HEIGHT // 20, WIDTH // 20)) < rng.choice([0.2, 0.9])
            masks[n, t] = encode_mask(np.kron(rough, np.ones((20, 20))))  # from the top to the bottom: runs wrap
    return masks


def test_it_equals_the_comparison_of_whole_images(monkeypatch):
    monkeypatch.setattr(mask_comparison, "_MESHES", 3)
    for seed, frames in itertools.product(range(3), (1, 3, 64)):
        monkeypatch.setattr(mask_comparison, "_FRAMES", frames)
        rng = np.random.default_rng(seed)
        shift = np.concatenate([rng.integers(-250, 250, (N, T, 2)), np.zeros((N, T, 1), int)], -1)
        result = solution(crop=(solution().crops.square_px + shift).astype(np.float32))
        masks = random_masks(seed)
        whole = {cell: masks.pop(cell) for cell in [(0, 1), (1, 2)]}
        masks[1, 0] = encode_mask(np.zeros((HEIGHT, WIDTH), bool))
        del masks[0, 3]
        seen = dataclasses.replace(truth(), masks=masks, amodal_masks=whole)
        measured = np.ones((N, T), bool)
        measured[1, 3] = False
        found, expected = (
            compare_masks(result, BIRD, seen, measured, AT, silent),
            by_whole_images(result, seen, measured),
        )
        np.testing.assert_array_equal(found.true_side_px, expected[1])
        # meshes of a batch round differently
        np.testing.assert_allclose(found.predicted_side_px, expected[2], atol=1)
        np.testing.assert_allclose(found.iou, expected[0], atol=1e-4)
        assert np.isfinite(found.iou).sum() >= 4


@pytest.mark.parametrize("shift_px", [0, 100])
def test_pixels_of_other_birds_do_not_count(shift_px):
    result = solution(
        crop=solution().crops.square_px + np.float32([shift_px, 0, 0])
    )  # the shifted meshes leave the image
    masks = random_masks(7)
    right = np.arange(WIDTH) >= WIDTH // 2  # bird 1 is near the right part of bird 0 only
    masks |= {(1, t): encode_mask(decode_mask(masks[1, t]) & right) for t in range(T)}
    seen, measured = dataclasses.replace(truth(), masks=masks), np.ones((N, T), bool)
    alone = [dataclasses.replace(seen, masks={(n, t): seen.masks[n, t] for t in range(T)}) for n in range(N)]
    found, expected = compare_masks(result, BIRD, seen, measured, AT, silent), by_whole_images(result, seen, measured)
    without = np.stack([by_whole_images(result, alone[n], measured)[0, n] for n in range(N)])
    np.testing.assert_allclose(found.iou, expected[0], atol=1e-4)
    assert (found.iou > without + 1e-3).any()


def test_photographs_and_meshes_that_reach_behind_the_camera():
    own = {(1, t): (f"{t}.png", WIDTH, HEIGHT) for t in range(T)}
    seen = dataclasses.replace(truth(), own_images=own, masks=random_masks(5))
    poses = solution().poses.transl.copy()
    poses[0, 0, 2] = 0.5
    poses[0, 1] = np.nan
    result = solution().with_arrays(transl=poses, valid=np.isfinite(poses).all(-1))
    measured = np.ones((N, T), bool)
    found, expected = compare_masks(result, BIRD, seen, measured, AT, silent), by_whole_images(result, seen, measured)
    np.testing.assert_allclose(found.iou, expected[0], atol=1e-4)
    np.testing.assert_allclose(found.predicted_side_px, expected[2], atol=1)
    assert np.isnan(found.predicted_side_px[0, 1])
    assert found.iou[0, 1] == 0


def test_annotations_without_masks():
    seen, measured = dataclasses.replace(truth(), masks={}), np.ones((N, T), bool)
    found, expected = compare_masks(known(), BIRD, seen, measured, AT, silent), by_whole_images(known(), seen, measured)
    assert np.isnan(found.iou).all()
    np.testing.assert_array_equal(found.true_side_px, expected[1])
    np.testing.assert_array_equal(found.predicted_side_px, expected[2])


def test_masks_of_one_chunk_of_frames_are_in_memory(monkeypatch):
    """The comparison reads the masks of a frame once, and in the order of the frames."""
    read = []

    class Recorded(dict):
        def __getitem__(self, cell):
            read.append(cell)
            return super().__getitem__(cell)

    monkeypatch.setattr(mask_comparison, "_FRAMES", 1)
    seen = dataclasses.replace(truth())
    object.__setattr__(seen, "masks", Recorded(seen.masks))
    compare_masks(solution(), BIRD, seen, np.ones((N, T), bool), AT, silent)
    assert [t for _, t in read] == sorted(t for _, t in read)
    assert len(read) == N * T
