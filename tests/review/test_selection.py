"""Selection: uncertain frames first, but no two frames that look alike or follow each other."""

import numpy as np

from jaxfit.review.signals import choose, shortlist, thumbnail


def looks(values):
    return np.repeat(np.asarray(values, np.float32)[:, None], 4, axis=1)


def test_a_still_video_gives_frames_far_apart():
    """Equal pictures with equal scores: frames are spread over the whole video."""
    chosen = sorted(choose(np.full(100, 0.5), looks(np.zeros(100)), np.arange(100), 10))
    assert np.diff(chosen).min() >= 4
    assert chosen[0] == 0
    assert chosen[-1] >= 90


def test_neighbours_of_a_chosen_frame_come_last():
    """A group of uncertain neighbours does not take all places."""
    score = np.full(100, 0.4)
    score[40:60] = 1
    chosen = choose(score, looks(np.random.default_rng(0).normal(size=100)), np.arange(100), 10)
    assert sum(40 <= t < 60 for t in chosen) >= 4
    assert np.diff(sorted(chosen)).min() >= 3


def test_an_unusual_picture_is_chosen():
    values = np.zeros(50)
    values[33] = 100
    assert 33 in choose(np.full(50, 0.5), looks(values), np.arange(50), 3)


def test_all_frames_can_be_chosen():
    chosen = choose(np.zeros(7), looks(np.zeros(7)), np.arange(7) * 5, 7)
    assert sorted(chosen) == list(range(7))


def test_the_shortlist_covers_the_video_and_the_largest_scores():
    score = np.zeros(2000)
    score[[1111, 1500]] = 1
    listed = shortlist(score, 10)
    assert len(listed) == 40
    assert {0, 1999, 1111, 1500} <= set(listed.tolist())
    assert np.diff(listed).max() <= 2000 / 19 + 1  # 20 frames are evenly spaced
    assert shortlist(score[:30], 10).tolist() == list(range(30))


def test_thumbnails_of_different_pictures_differ():
    black, half = np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80, 3), np.uint8)
    half[:, 40:] = 200
    assert np.linalg.norm(thumbnail(black) - thumbnail(half)) > np.linalg.norm(thumbnail(half) - thumbnail(half + 1))
