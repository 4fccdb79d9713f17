"""Simulated scenes for training: labels agree with the pictures, filming into folders, joined and damaged folders."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks import scenes
from jaxfit.learning.networks.labelled_frames import load_frames, save_labels
from jaxfit.learning.networks.labels import load_reference_birds
from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, MAX_VARIED_BIRDS, draw_frames, draw_scene, film_scenes
from jaxfit.learning.networks.varied import draw_species
from jaxfit.model.files import load_murre

K = 20
WIDTH, HEIGHT = 240, 160


def write_scene(folder, seed, *_shares, **changed):
    """Write two small frames of `seed` + 1 birds, whose pixels and keypoints are the number of the scene."""
    folder.mkdir(parents=True)
    np.save(folder / "pictures.npy", np.full((2, 4, 6, 3), seed, np.uint8))
    np.save(folder / "owner.npy", np.zeros((2, 4, 6), np.uint8))
    labels = {
        "keypoints_px": np.full((2, seed + 1, K, 2), seed, np.float32),
        "visibility": np.full((2, seed + 1, K), 2, np.uint8),
        "pixels_per_unit": np.full(2, 1 + seed, np.float32),
    }
    np.savez(folder / "frames.npz", **labels | changed)


class Pool:
    """A pool that films in this process."""

    def __init__(self, *_arguments):
        pass

    __enter__ = __exit__ = lambda self, *_error: self if not _error else None
    map = staticmethod(map)


@pytest.fixture
def filmed(monkeypatch):
    """The seeds and shares of the scenes that are filmed."""
    calls = []

    def film(folder, seed, **shares):
        calls.append((seed, *shares.values()))
        write_scene(folder, seed)

    monkeypatch.setattr(scenes, "film_scene", film)
    monkeypatch.setattr(scenes, "ProcessPoolExecutor", Pool)
    return calls


def test_only_missing_scenes_are_filmed_with_the_shares_of_the_folder(filmed, tmp_path):
    write_scene(tmp_path / "usual" / "scene_0001", 1)
    assert scenes.missing_scenes(tmp_path / "usual", 3) == 2
    folders = film_scenes(tmp_path / "usual", 3)
    assert filmed == [(0, 0.0, 0.0), (2, 0.0, 0.0)]
    joined = load_frames(*folders)
    assert [int(picture[0, 0, 0]) for picture in joined.pictures] == [0, 0, 1, 1, 2, 2]
    assert joined.owner.shape == (6, 4, 6)
    assert joined.known.any(-1).sum(1).tolist() == [1, 1, 2, 2, 3, 3]
    assert joined.keypoints_px[3, :, 0].tolist() == [[1, 1], [1, 1], [0, 0]]
    assert joined.pixels_per_unit.tolist() == [1, 1, 2, 2, 3, 3]
    assert film_scenes(tmp_path / "usual", 2) == folders[:2]

    film_scenes(tmp_path / "wings", 1, 0.25, 0.5)
    film_scenes(tmp_path / "wings", 2)
    assert filmed[2:] == [(0, 0.25, 0.5), (1, 0.25, 0.5)]
    with pytest.raises(InputError, match=r"holds scenes of .*'wings': 0.5.*not of .*'wings': 0.0"):
        film_scenes(tmp_path / "wings", 2, 0.25, 0.0)


def test_the_end_of_a_process_is_one_error(monkeypatch, tmp_path):
    def film(*_arguments, **_shares):
        raise scenes.BrokenProcessPool

    monkeypatch.setattr(scenes, "film_scene", film)
    monkeypatch.setattr(scenes, "ProcessPoolExecutor", Pool)
    with pytest.raises(InputError, match="the system ended a process that films scenes"):
        film_scenes(tmp_path / "scenes", 3)


def test_folders_of_other_files_are_rejected(filmed, tmp_path):
    (tmp_path / "holiday.png").touch()
    with pytest.raises(InputError, match=r"holds other files than simulated scenes: holiday.* .*--frames"):
        film_scenes(tmp_path, 20)
    assert not filmed


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"keypoints_px": np.full((2, 2, K, 2), np.nan, np.float32)}, "wrong position of a keypoint"),
        ({"visibility": np.full((2, 2, K), 4, np.uint8)}, "wrong visibility"),
        ({"visibility": np.zeros((2, 2, K))}, "wrong type of numbers"),
        ({"pixels_per_unit": np.zeros(2, np.float32)}, "wrong scale"),
        ({"pixels_per_unit": np.zeros(3, np.float32)}, r"frames\.npz"),
    ],
)
def test_impossible_labels(tmp_path, changed, message):
    write_scene(tmp_path / "scene", 1, **changed)
    with pytest.raises(InputError, match=message):
        load_frames(tmp_path / "scene")


def test_keypoints_far_outside_the_picture_are_clipped(tmp_path):
    write_scene(tmp_path / "scene", 1)
    frames = load_frames(tmp_path / "scene")
    points, visibility = frames.keypoints_px.copy(), frames.visibility.copy()
    points[0, 1, 3], visibility[0, 1, 3] = (-6e8, 20), 0
    save_labels(tmp_path / "scene", points, visibility, frames.pixels_per_unit)
    assert load_frames(tmp_path / "scene").keypoints_px[0, 1, 3].tolist() == [-1e6, 20]


@pytest.fixture(scope="module")
def varied():
    return [draw_frames(np.random.default_rng(seed), load_murre(), 1, WIDTH, HEIGHT) for seed in range(4)]


@pytest.mark.extended
def test_varied_birds_agree_with_their_labels(varied):
    """A visible keypoint is at most one pixel away from its bird, and a bird that is shown has a bird's size."""
    shown = 0
    for frames in varied:
        picture, owner = frames.pictures[0].astype(int), frames.owner[0]
        assert owner.max() <= MAX_VARIED_BIRDS
        for n, k in np.argwhere(frames.visibility[0] == 2).tolist():
            x, y = frames.keypoints_px[0, n, k].astype(int)
            assert binary_dilation(owner == n + 1, iterations=2)[y, x]
            shown += 1
        lengths = [np.ptp(np.argwhere(owner == n), axis=0).max() for n in np.unique(owner[owner > 0])]
        assert max(lengths, default=0) < 3 * 20 * frames.pixels_per_unit[0]
        inside = ((frames.keypoints_px >= 0) & (frames.keypoints_px < [WIDTH, HEIGHT])).all(-1)
        assert not frames.visibility[~inside].any()
        assert picture[owner > 0].std() > 3
    assert shown > 20
    again = draw_frames(np.random.default_rng(2), load_murre(), 1, WIDTH, HEIGHT)
    for one, other in zip(again[:5], varied[2][:5], strict=True):
        np.testing.assert_array_equal(one, other)


def test_species_differ_and_keep_the_joint_tree():
    bird = load_murre()
    species = [draw_species(np.random.default_rng(seed), bird) for seed in range(3)]
    for one in species:
        assert one.body.parents == bird.parents
        assert ((one.colours >= 0.01) & (one.colours <= 0.95)).all()
    assert np.ptp([np.ptp(np.asarray(one.body.vertices)[:, 1]) for one in species]) > 1


@pytest.mark.extended
def test_a_filmed_scene(tmp_path):
    """Visible keypoints lie on their bird; the seed determines the frames, on a ledge or, by its share, elsewhere."""
    (folder,) = film_scenes(tmp_path / "scenes", 1)
    frames = load_frames(folder)
    assert len(frames.pictures) == FRAMES_PER_SCENE
    visible = np.argwhere(frames.visibility == 2)
    assert len(visible) > 100
    on_bird = 0
    for s, n, k in visible:
        x, y = frames.keypoints_px[s, n, k].astype(int)
        on_bird += (frames.owner[s][max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] == n + 1).any()
    assert on_bird > 0.99 * len(visible)  # the thinnest tips fall between pixels
    seed = next(seed for seed in range(9) if np.random.default_rng((seed, 11)).random() >= 0.5)
    np.testing.assert_array_equal(frames.pictures, draw_scene(0, varied=0.5 if seed == 0 else 0).pictures)


def reference_birds(seed):
    """Simulate the birds of a scene; return their keypoints, with a mean of 0 and a range of 1, and which are known.

    `reference_birds.npz` holds the birds of the scenes 0 to 19, as float16.
    """
    scene = scenes.simulate_ledge(seed, load_murre())
    view = scene.footage.view
    points = view.to_screen(scene.keypoints[list(scene.kept)])[..., :2]
    known = np.all((points >= 0) & (points < [view.width, view.height]), axis=-1)
    points, known = points.reshape(-1, *points.shape[2:]), known.reshape(-1, known.shape[-1])
    points = points - points.mean(1, keepdims=True)
    points /= np.ptp(points, axis=1).max(-1)[:, None, None]
    return points[known.any(-1)], known[known.any(-1)]


@pytest.mark.extended
def test_the_stored_reference_birds_are_those_of_the_scenes():
    birds = load_reference_birds()
    points, known = reference_birds(0)
    np.testing.assert_allclose(birds.keypoints_px[: len(points), 0], points, atol=2e-3)
    np.testing.assert_array_equal(birds.known[: len(points), 0], known)
    assert len(birds.visibility) > 1500
