"""Windows that are fitted while a video is tracked: `fit` takes them from the store, and its result is the same."""

import dataclasses

import numpy as np
import pytest
from support.fits import BIRD, CAMERA, T, config, truths
from support.worker_tasks import quick_fit

from jaxfit.fitting import provisional, tasks
from jaxfit.fitting.fit import fit
from jaxfit.fitting.provisional import ProvisionalFit
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster, FailedTask
from jaxfit.simulation.noise import detect

FRAMES, BIRDS = 40, 3
STEP, LATER = 5, 2


@pytest.fixture(autouse=True)
def fitted(monkeypatch):
    """Replace fits by values that depend on the window; return the (track, last position) of all fitted windows."""
    done = []

    def recorded(shared, task, report_progress=None):
        windows = task.windows[0]
        done.extend((int(windows.track_id[w]), int(windows.frame[w].max(initial=-1))) for _, w in task.problems)
        return quick_fit(shared, task)

    monkeypatch.setattr(tasks, "fit_task", recorded)
    monkeypatch.setattr(provisional, "STEP_FRAMES", STEP)
    monkeypatch.setattr(provisional, "LATER_FRAMES", LATER)
    return done


def settings(**changes):
    return dataclasses.replace(config(memory_gb=1.0), **changes)


def observe(**changes):
    return dataclasses.replace(detect(BIRD, truths(FRAMES, BIRDS), 1.0, 0.05, 0, camera=CAMERA), **changes)


def absent(observed, track, frames):
    """Return the observations without a bird in some frames."""
    present, confidence = observed.present.copy(), observed.confidence.copy()
    present[track, frames], confidence[track, frames] = False, 0
    masks = {(n, t): mask for (n, t), mask in observed.masks.items() if present[n, t]}
    return dataclasses.replace(observed, present=present, confidence=confidence, masks=masks)


def follow(observed, some, folder, frames=FRAMES, cluster=None):
    """Fit the complete windows after each of the frames, and return the store."""
    stored = StoredWindows(Parts(folder, {}))
    with ProvisionalFit(BIRD, some, stored, cluster=cluster) as provisional_fit:
        for count in range(1, frames + 1):

            def observations_from(first, count=count):
                part = observed.select(frames=slice(first, count))
                return part.select(tracks=part.present.any(1))

            provisional_fit(observations_from)
    return stored


def assert_fit_is_plain(observed, some, stored):
    expected = fit(observed, BIRD, some)
    solution = fit(observed, BIRD, some, stored=stored)
    assert expected.valid.any()
    for name in ("keypoints_px", "keypoints_cam", "scale", "global_orient", "valid", "status"):
        np.testing.assert_array_equal(getattr(solution, name), getattr(expected, name), err_msg=name)


def fit_again(observed, some, stored, fitted):
    """Fit the whole video with the store; return the windows that were fitted."""
    fitted.clear()
    fit(observed, BIRD, some, stored=stored)
    return sorted(fitted)


CHANGES = {
    "every frame": {},
    "windows that share frames": {"overlap": 2},
    "filtered keypoints": {"filter_window": 7},
    "unknown pixels": {"unknown_pixels": True},
}


@pytest.mark.parametrize("changes", CHANGES.values(), ids=CHANGES)
def test_complete_windows_are_fitted_once(changes, fitted, tmp_path):
    observed, some = observe(), settings(**changes)
    stored = follow(observed, some, tmp_path)
    margin = max(LATER, some.filter_window // 2)
    starts = range(0, FRAMES - some.overlap, T - some.overlap)
    complete = [start + T - 1 for start in starts if start + T + margin <= FRAMES]
    assert len(complete) >= 5
    early = sorted(fitted)
    full = BIRDS * len(complete) // 2 * 2  # a tile holds two windows
    assert len(early) == len(set(early)) == full
    late = fit_again(observed, some, stored, fitted)
    assert not set(late) & set(early)
    assert len(late) == BIRDS * len(starts) - full
    assert_fit_is_plain(observed, some, stored)


@pytest.mark.parametrize("numbers", [[0, 1, 2, *range(9, 37)], range(1, 40, 2), [3, *range(8, 40)]])
def test_frames_that_cannot_be_read(numbers, fitted, tmp_path):
    """Windows count frame numbers; the positions of later frames are smaller."""
    observed = observe(frame_index=np.arange(FRAMES)).select(frames=np.array(numbers))
    stored = follow(observed, settings(), tmp_path, len(numbers))
    early = set(fitted)
    assert len(early) >= 2 * BIRDS
    assert not set(fit_again(observed, settings(), stored, fitted)) & early
    assert_fit_is_plain(observed, settings(), stored)


def test_birds_that_come_and_go(fitted, tmp_path):
    observed = absent(observe(), 0, slice(14, None))  # leaves
    observed = absent(absent(observed, 1, slice(0, 3)), 1, slice(13, 27))  # comes late, and is hidden for long
    observed = absent(observed, 2, [7, 8, 9, 20])
    stored = follow(observed, settings(), tmp_path)
    early = set(fitted)
    assert {(0, 5), (0, 11), (0, 13), (1, 8)} < early
    late = fit_again(observed, settings(), stored, fitted)
    assert set(late) & early == set()
    assert (1, 14) in late  # without the later frames, the window ended at frame 12
    assert_fit_is_plain(observed, settings(), stored)


def test_a_neighbour_that_is_skipped_in_the_end(fitted, tmp_path):
    """The masks of a neighbour belong to the windows, so these windows are fitted again."""
    some = settings(unknown_pixels=True)
    observed = observe()
    stored = follow(observed, some, tmp_path)
    kept = observed.select(tracks=[0, 1])
    assert_fit_is_plain(kept, some, stored)


def test_the_same_frames_again(fitted, tmp_path):
    """After an interruption, the frames are the same and no stored window is fitted."""
    observed = observe()
    follow(observed, settings(), tmp_path, 23)
    first = list(fitted)
    assert first
    follow(observed, settings(), tmp_path)
    assert len(fitted) == len(set(fitted)) > len(first)


def test_an_unusable_setting_is_reported_at_the_first_window(tmp_path):
    observed = observe(image_size_px=np.full((FRAMES, 2), [80, 64]), own_images={}, masks={})
    with pytest.raises(InputError, match="needs square images of one size"):
        follow(observed, settings(), tmp_path, 15)
    follow(observed, settings(), tmp_path, T + LATER)


def test_a_failed_task_is_left_to_the_fit(fitted, tmp_path):
    class OneFails(Cluster):
        def run(self, function, shared, tasks):
            for i, task in enumerate(tasks):
                yield i, FailedTask("lost") if not fitted else function(shared, task)
                fitted.append(None)

    stored = follow(observe(), settings(), tmp_path, 15, OneFails(None, ""))
    assert_fit_is_plain(observe(), settings(), stored)


def test_frames_without_birds(fitted, tmp_path):
    observed = absent(absent(absent(observe(), 0, slice(None)), 1, slice(None)), 2, slice(None))
    follow(observed, settings(), tmp_path)
    assert not fitted
