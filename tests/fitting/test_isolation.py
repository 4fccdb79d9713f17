"""The result of a bird is the same, bit by bit, alone and among any other birds."""

import dataclasses

import numpy as np
import pytest
from support.fits import BIRD, CAMERA, T, config, replaced, truths

from jaxfit.fitting.fit import fit
from jaxfit.fitting.tiles import FRAMES_PER_TILE, join_tiles, take_tile, tile_rows, tile_size
from jaxfit.model.kinematics import Pose
from jaxfit.simulation.noise import detect

pytestmark = pytest.mark.usefixtures("distant_birds")
ARRAYS = [*Pose.__dataclass_fields__, "keypoints_cam", "keypoints_px", "valid"]
BIRDS, DIVERGING = 4, 1


def assert_independent(observed, settings, groups):
    """Fit all birds, fit every group of birds, and compare. The fit of bird `DIVERGING` diverges."""
    together = fit(observed, BIRD, settings)
    assert np.flatnonzero(together.status == "diverged").tolist() == [DIVERGING]
    for group in groups:
        apart = fit(observed.select(tracks=group), BIRD, settings)
        for name in ARRAYS:
            expected, actual = together.arrays()[name][group], apart.arrays()[name]
            np.testing.assert_array_equal(actual, expected, err_msg=f"{name} of the birds {group}")
        for term, loss in apart.loss.items():
            np.testing.assert_array_equal(loss, together.loss[term][group], err_msg=f"{term} of the birds {group}")


def observe(frames):
    """Return noisy observations of tiny birds. The squared keypoints of one bird exceed float32."""
    observed = detect(BIRD, truths(frames, BIRDS), 1.0, 0.05, 0, camera=CAMERA)
    return replaced(observed, DIVERGING, np.full((frames, BIRD.num_keypoints, 2), 1e30))


@pytest.mark.extended
def test_birds_do_not_depend_on_each_other():
    """The groups change the number of birds, their order, and the position of a bird in its tile."""
    groups = [[2], [3, DIVERGING, 0]]
    assert_independent(observe(T), config(steps=(30, 3), memory_gb=1.0), groups)


@pytest.mark.extended
@pytest.mark.parametrize("window", [1, 5])
def test_birds_in_short_windows_do_not_depend_on_each_other(window):
    settings = config(window=window, steps=(60, 5), memory_gb=1.0)
    assert_independent(observe(2 * window), settings, [[0], [2], [3, DIVERGING, 0]])


def test_tiles_hold_every_row_once():
    for count in (1, 2, 5, 6):
        tiles = tile_rows(count, 2)
        assert {len(tile) for tile in tiles} == {2}
        rows = np.concatenate(tiles)
        assert rows[:count].tolist() == list(range(count))
        assert (rows[count:] == -1).all()
        tree = {"a": np.arange(count), "b": np.ones((count, 3))}
        joined = join_tiles([take_tile(tree, tile) for tile in tiles], count)
        for name, array in tree.items():
            np.testing.assert_array_equal(joined[name], array)


def test_the_size_of_a_tile_depends_only_on_the_length_of_the_windows():
    assert [tile_size(frames) for frames in (1, 4, 6, 16, 100)] == [FRAMES_PER_TILE, 4, 2, 2, 2]


@pytest.mark.extended
def test_birds_with_hypotheses_do_not_depend_on_each_other():
    settings = config(steps=(60, 5), memory_gb=1.0)
    initialise = dataclasses.replace(settings.initialise, hypotheses=3)
    assert_independent(observe(T), dataclasses.replace(settings, initialise=initialise), [[0], [2], [3, DIVERGING, 0]])
