"""Memory of a fit: refused by estimate, with the figure and a remedy; filtered in parts without a difference."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest
from support.birds import tiny_bird
from support.fits import config

from jaxfit.config.fit import load_config
from jaxfit.data.observations import Observations
from jaxfit.fitting import windows
from jaxfit.fitting.fit import check_fit_memory
from jaxfit.fitting.windows import cut_windows, filter_observations
from jaxfit.foundation.array_files import check_memory
from jaxfit.foundation.errors import InputError
from jaxfit.model.files import load_murre

PAPER = load_config("paper")


def tracks(birds=3, frames=6, numbers=None):
    rng = np.random.default_rng(0)
    return Observations(
        track_id=np.arange(birds),
        frame_index=np.arange(frames) if numbers is None else np.array(numbers),
        present=np.ones((birds, frames), bool),
        keypoints_px=rng.uniform(0, 60, (birds, frames, 5, 2)),
        confidence=rng.uniform(0, 1, (birds, frames, 5)),
        box_px=np.zeros((birds, frames, 4)),
        image_size_px=np.full((frames, 2), 64),
        file_name=np.full(frames, "a.png"),
        keypoint_names=tuple("abcde"),
    )


@pytest.mark.parametrize(
    ("size", "changes", "message"),
    [
        (
            (1000, 1000),
            {},
            "b.json: the poses of 1,000 tracks over 1,000 frames need 3.2 GB, more than 3 GB .*memory_gb",
        ),
        ((3600, 3600), {}, "the poses of 3,600 tracks over 3,600 frames need 42.1 GB"),
        ((1, 1), {"window": 10_000, "size_px": 1024}, "config: the arrays of a window of 10,000 frames need .* 8 GB"),
        ((1, 1), {"hypotheses": 100, "window": 1000}, "the arrays of a window of 1,000 frames need .*initialise"),
    ],
)
def test_fits_are_refused_by_estimate(size, changes, message):
    initialise = dataclasses.replace(PAPER.initialise, hypotheses=changes.pop("hypotheses", 1))
    crop = dataclasses.replace(PAPER.crop, size_px=changes.pop("size_px", 256))
    settings = dataclasses.replace(PAPER, initialise=initialise, crop=crop, **changes)
    observations = SimpleNamespace(num_tracks=size[0], num_frames=size[1])
    with pytest.raises(InputError, match=message):
        check_fit_memory(observations, load_murre(), [settings], "b.json")


def test_usual_fits_are_not_refused():
    for size in ((20, 10_000), (3600, 1)):
        check_fit_memory(SimpleNamespace(num_tracks=size[0], num_frames=size[1]), load_murre(), [PAPER], "b.json")
    long = dataclasses.replace(PAPER, window=1000)
    check_fit_memory(SimpleNamespace(num_tracks=9, num_frames=1000), load_murre(), [long] * 3, "b.json")
    check_fit_memory(SimpleNamespace(num_tracks=9, num_frames=100), tiny_bird(), [config()], "b.json")


def test_windows_are_refused_by_estimate():
    photographs = tracks(birds=600, frames=1)
    with pytest.raises(InputError, match=r"600 windows of 10,000 frames need 2.3 GB, more than 2 GB \(lower `window`"):
        cut_windows(photographs, config(10_000))
    assert len(cut_windows(photographs, config(100))) == 600


@pytest.mark.extended
def test_the_filter_works_in_parts(monkeypatch):
    observations = tracks()
    whole = filter_observations(observations, 5).keypoints_px
    monkeypatch.setattr(windows, "FILTER_BYTES", 1)
    np.testing.assert_array_equal(filter_observations(observations, 5).keypoints_px, whole)
    monkeypatch.setattr(windows, "check_memory", functools.partial(check_memory, allowed_gb=1e-3))
    gaps = tracks(birds=1, frames=200, numbers=[*range(199), 19_000])
    with pytest.raises(InputError, match=r"the arrays of the filter over 19,001 frame numbers need"):
        filter_observations(gaps, 5)
