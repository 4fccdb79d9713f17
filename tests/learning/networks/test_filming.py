"""Simulated scenes that are filmed while a network trains."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks import filming
from jaxfit.learning.networks.filming import Filming, missing_scenes
from jaxfit.learning.networks.labelled_frames import create_pictures, join_frames, load_frames, save_labels
from jaxfit.learning.networks.loop import Source, _Order, _Samples
from jaxfit.learning.networks.reference_birds import load_reference_birds, scene_birds
from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, film_scene, film_scenes

K = 20


def write_scene(folder, seed):
    """Write two small frames of `seed` + 1 birds, whose pixels and keypoints are the number of the scene."""
    folder.mkdir(parents=True)
    pictures, owner = create_pictures(folder, 2, 4, 6)
    pictures[:], owner[:] = seed, 0
    del pictures, owner
    points, visibility = np.full((2, seed + 1, K, 2), seed, np.float32), np.full((2, seed + 1, K), 2, np.uint8)
    save_labels(folder, points, visibility, np.full(2, 1 + seed, np.float32))


@pytest.fixture
def camera(monkeypatch):
    """Film in threads of this process; scene n is complete only after `camera[n]` is set."""
    events = [threading.Event() for _ in range(5)]

    def film(folder, seed):
        events[seed].wait(30)
        write_scene(folder, seed)

    monkeypatch.setattr(filming, "film_scene", film)
    monkeypatch.setattr(filming, "ProcessPoolExecutor", lambda workers, *_others: ThreadPoolExecutor(workers))
    yield events
    for event in events:
        event.set()


def number_of_scene(rng, frames):
    return int(frames.pictures[int(rng.integers(len(frames.pictures)))][0, 0, 0])


def growing(films, samples_per_folder=10):
    first, *more = films.folders
    return Source(first, number_of_scene, 1.0, None, tuple(more), samples_per_folder, films.wait)


def test_samples_come_before_all_scenes_are_filmed(camera, tmp_path):
    """The first samples need the first scene only; a later sample waits for the scenes that it may come from."""
    with Filming(tmp_path / "scenes", 3) as films:
        source = growing(films)
        order, samples = iter(_Order([source], 0, 40)), _Samples([source], 0, 0, 40)
        camera[0].set()
        assert [samples[next(order)] for _ in range(10)] == [0] * 10
        assert not (tmp_path / "scenes" / "scene_0001").exists()
        threading.Timer(0.1, camera[1].set).start()
        assert 1 in [samples[next(order)] for _ in range(10)]
        camera[2].set()
        assert {samples[i] for i in order} == {0, 1, 2}


def test_samples_do_not_depend_on_the_time_of_filming(camera, tmp_path):
    for event in camera:
        event.set()
    with Filming(tmp_path / "scenes", 3) as films:
        films.wait(3)
        source = growing(films)
        samples = _Samples([source], 0, 0, 40)
        drawn = [samples[i] for i in range(40)]
    assert set(drawn[:10]) == {0}
    assert set(drawn[10:20]) <= {0, 1}
    later = _Samples([source], 0, 15, 25)  # after an interruption
    assert [later[i] for i in range(25)] == drawn[15:]


def test_only_missing_scenes_are_filmed(camera, tmp_path):
    write_scene(tmp_path / "scene_0001", 1)
    assert missing_scenes(tmp_path, 3) == 2
    camera[0].set()
    camera[2].set()
    with Filming(tmp_path, 3) as films:
        assert films.frames(3).pixels_per_unit.tolist() == [1, 1, 2, 2, 3, 3]
    assert missing_scenes(tmp_path, 3) == 0
    with Filming(tmp_path, 2) as films:
        assert len(films.frames(2).pictures) == 4


def test_scenes_that_are_not_needed_are_not_filmed(camera, tmp_path):
    with Filming(tmp_path / "scenes", 5) as films:
        camera[0].set()
        films.wait(1)
        threading.Timer(0.1, lambda: [event.set() for event in camera]).start()
    assert not (tmp_path / "scenes" / "scene_0004").exists()


def test_a_worker_films_nothing_after_the_end(monkeypatch, tmp_path):
    monkeypatch.setattr(filming, "film_scene", write_scene)
    monkeypatch.setattr(filming, "_STOP", [threading.Event()])
    filming._film(tmp_path / "scene_0000", 0)
    filming._STOP[0].set()
    filming._film(tmp_path / "scene_0001", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["scene_0000"]


def test_a_folder_with_all_scenes_is_used_as_it_is(tmp_path):
    write_scene(tmp_path / "scenes", 3)
    assert missing_scenes(tmp_path / "scenes", 20) == 0
    with Filming(tmp_path / "scenes", 20) as films:
        assert len(films.frames(1).pictures) == 2
        assert films.identity == (tmp_path / "scenes" / "frames.npz").read_bytes()


def test_other_folders_are_refused(tmp_path):
    (tmp_path / "holiday.png").touch()
    with pytest.raises(InputError, match=r"holds other files than simulated scenes: holiday\.png .*--frames"):
        Filming(tmp_path, 20)


def test_an_error_of_filming_is_an_error_of_the_training(monkeypatch, tmp_path):
    def film(folder, seed):
        raise InputError(folder, "is on a full disk", "free some space")

    monkeypatch.setattr(filming, "film_scene", film)
    monkeypatch.setattr(filming, "ProcessPoolExecutor", lambda workers, *_others: ThreadPoolExecutor(workers))
    with pytest.raises(InputError, match="full disk"), Filming(tmp_path / "scenes", 3) as films:
        list(_Order([growing(films)], 0, 40))


def test_joined_frames(tmp_path):
    for seed in range(3):
        write_scene(tmp_path / str(seed), seed)
    parts = [load_frames(tmp_path / str(seed)) for seed in range(3)]
    joined = join_frames(parts)
    assert [int(picture[0, 0, 0]) for picture in joined.pictures] == [0, 0, 1, 1, 2, 2]
    assert joined.owner.shape == (6, 4, 6)
    assert joined.known.any(-1).sum(1).tolist() == [1, 1, 2, 2, 3, 3]
    assert joined.keypoints_px[3, 1, 0].tolist() == [1, 1]
    assert joined.keypoints_px[3, 2, 0].tolist() == [0, 0]
    assert join_frames(parts[:1]) is parts[0]


@pytest.mark.extended
def test_the_stored_reference_birds_are_those_of_the_scenes():
    birds = load_reference_birds()
    points, known = scene_birds(0)
    np.testing.assert_allclose(birds.keypoints_px[: len(points), 0], points, atol=2e-3)
    np.testing.assert_array_equal(birds.known[: len(points), 0], known)
    assert len(birds.visibility) > 1500


@pytest.mark.extended
def test_a_filmed_scene_is_that_of_a_whole_folder(tmp_path):
    whole = film_scenes(tmp_path / "whole", range(1), workers=1)
    film_scene(tmp_path / "scene", 0)
    film_scene(tmp_path / "scene", 0)  # keeps the folder
    own = load_frames(tmp_path / "scene")
    assert len(own.pictures) == FRAMES_PER_SCENE
    for name in ("pictures", "owner", "keypoints_px", "visibility", "pixels_per_unit"):
        np.testing.assert_array_equal(getattr(own, name), getattr(whole, name))
