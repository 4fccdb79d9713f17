"""Frames of random birds in random landscapes: their labels agree with their pictures."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, MAX_VARIED_BIRDS, draw_frames, film_scenes
from jaxfit.learning.networks.varied import draw_landscape, draw_species
from jaxfit.model.files import load_murre

pytestmark = pytest.mark.extended  # half a minute

WIDTH, HEIGHT = 240, 160


@pytest.fixture(scope="module")
def scenes():
    return [draw_frames(np.random.default_rng(seed), load_murre(), 1, WIDTH, HEIGHT) for seed in range(4)]


def test_visible_keypoints_lie_on_their_bird(scenes):
    """A keypoint is at most one pixel away from its bird, and a bird that is shown has a bird's size."""
    shown = 0
    for frames in scenes:
        owner = frames.owner[0]
        assert owner.max() <= MAX_VARIED_BIRDS
        for n, k in np.argwhere(frames.visibility[0] == 2).tolist():
            x, y = frames.keypoints_px[0, n, k].astype(int)
            assert binary_dilation(owner == n + 1, iterations=2)[y, x]
            shown += 1
        lengths = [np.ptp(np.argwhere(owner == n), axis=0).max() for n in np.unique(owner[owner > 0])]
        assert max(lengths, default=0) < 3 * 20 * frames.pixels_per_unit[0]
    assert shown > 20


def test_keypoints_outside_the_picture_are_not_visible(scenes):
    for frames in scenes:
        inside = ((frames.keypoints_px >= 0) & (frames.keypoints_px < [WIDTH, HEIGHT])).all(-1)
        assert not frames.visibility[~inside].any()


def test_birds_differ_from_the_ground(scenes):
    """The pixels of birds are drawn: the same seed without birds gives other pixels there."""
    for frames in scenes:
        picture, owner = frames.pictures[0].astype(int), frames.owner[0]
        assert picture[owner > 0].std() > 3
        assert picture.std() > 3


def test_the_seed_determines_the_frames(scenes):
    again = draw_frames(np.random.default_rng(2), load_murre(), 1, WIDTH, HEIGHT)
    for one, other in zip(again[:5], scenes[2][:5], strict=True):
        np.testing.assert_array_equal(one, other)
    assert len({frames.pictures.tobytes() for frames in scenes}) == len(scenes)


def test_species_differ_and_keep_the_joint_tree():
    bird = load_murre()
    species = [draw_species(np.random.default_rng(seed), bird) for seed in range(3)]
    for one in species:
        assert one.body.parents == bird.parents
        assert np.isfinite(np.asarray(one.body.vertices)).all()
        assert ((one.colours >= 0.01) & (one.colours <= 0.95)).all()
    lengths = [np.ptp(np.asarray(one.body.vertices)[:, 1]) for one in species]
    assert np.ptp(lengths) > 1


@pytest.mark.parametrize("pitch_deg", [0, 30, 90])
def test_landscapes(pitch_deg):
    for seed in range(3):
        landscape = draw_landscape(np.random.default_rng((seed, pitch_deg)), WIDTH, HEIGHT, pitch_deg)
        assert landscape.picture.shape == (HEIGHT, WIDTH, 3)
        assert np.isfinite(landscape.picture).all()
        assert 0 <= landscape.water_from <= HEIGHT


def test_both_kinds_of_scenes(tmp_path):
    """The share decides the kind of every scene; the scenes on ledges do not change."""
    mixed = film_scenes(tmp_path / "mixed", range(2), varied=0.5)
    ledge = film_scenes(tmp_path / "ledge", range(2))
    same = [
        np.array_equal(mixed.pictures[s], ledge.pictures[s]) for s in range(0, 2 * FRAMES_PER_SCENE, FRAMES_PER_SCENE)
    ]
    kinds = [np.random.default_rng((seed, 11)).random() < 0.5 for seed in range(2)]
    assert same == [not kind for kind in kinds]
