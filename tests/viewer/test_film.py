"""Pictures of the film: the requested frames, in any order and from several threads."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from support import films

from jaxfit.foundation.errors import InputError
from jaxfit.viewer import film as module
from jaxfit.viewer.film import Pictures


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A film whose pictures hold their numbers, with a keyframe every 40 frames."""
    return films.encode(tmp_path_factory.mktemp("film") / "numbered.mp4", count=200, gop=40, b_frames=3)


def number_of(jpeg):
    return films.number_in(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))


WAYS = {
    "forward": range(20, 80),
    "backward": range(150, 20, -1),
    "to and fro": [*range(30, 60), *range(60, 30, -1), *range(30, 90, 3), *range(90, 0, -3)],
    "jumps": np.random.default_rng(0).integers(0, 200, 20).tolist(),
}


@pytest.mark.parametrize("way", WAYS)
def test_any_way_through_a_film_shows_its_frames(video, way, monkeypatch):
    monkeypatch.setattr(module, "MOST_BYTES", 100_000)  # some 40 pictures
    pictures = Pictures(video, np.arange(200))
    for number in WAYS[way]:
        assert number_of(pictures.picture(number)) == number
    assert sum(map(len, pictures._pictures.values())) <= 100_000


def test_frames_with_steps_and_gaps(video):
    frames = np.array([4, 8, 12, 40, 44, 196])
    pictures = Pictures(video, frames)
    for number in (*frames, *frames[::-1]):
        assert number_of(pictures.picture(int(number))) == number
    with pytest.raises(InputError, match="no frame 16"):
        pictures.picture(16)


def test_several_pages_at_once(video):
    pictures, numbers = Pictures(video, np.arange(200)), [150, 20, 149, 21, 148, 22, 199, 0] * 3
    with ThreadPoolExecutor(8) as pool:
        assert [number_of(jpeg) for jpeg in pool.map(pictures.picture, numbers)] == numbers


def test_a_wide_film_is_shown_smaller_and_a_short_one_ends(video, monkeypatch):
    monkeypatch.setattr(module, "MAX_WIDTH", 100)
    pictures = Pictures(video, np.arange(210))
    small = cv2.imdecode(np.frombuffer(pictures.picture(30), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (40, 64, 3)  # half of 80 × 128
    for _ in range(2):
        with pytest.raises(InputError, match="no frame 20"):
            pictures.picture(205)
    assert pictures.picture(199)
