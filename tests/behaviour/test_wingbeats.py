"""Frequency, amplitude and phase of wingbeats: sinusoids through poses and flocks, and the spectrum alone."""

import numpy as np
import pytest
from support.described import STRAIGHT, flock, result, straight_wings

from jaxfit.behaviour.birds import usual_steps
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.rhythm import rhythm_of

NAMES = ("beat_frequency", "beat_alias", "beat_amplitude", "stroke_phase")


def beating(frequency_hz, fps, seconds, amplitude=30.0, middle=5.0, start=0.4):
    """Return the features of birds whose wing elevation is a sinusoid, a bird for each frequency, and the phases."""
    time_s = np.arange(round(seconds * fps)) / fps
    phase = 2 * np.pi * np.asarray(frequency_hz, float)[:, None] * time_s - start
    poses = straight_wings(middle + amplitude * np.cos(phase))
    solution = result(poses, place_m=[0, 0, 0.2], bird=STRAIGHT)
    return describe(flock(solution, fps, bird=STRAIGHT)).values, phase


def signal(time_s, frequency_hz, amplitude=20.0):
    return 10 + amplitude * np.cos(2 * np.pi * frequency_hz * time_s + 1)


def rhythms(values, time_s):
    """Return the rhythms of some birds."""
    interval_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.nan
    return rhythm_of(values, time_s, usual_steps(time_s), interval_s, 5.0)


def rhythm(values, time_s):
    """Return the rhythm of one bird."""
    found = rhythms(np.asarray(values, float)[None], time_s)
    return type(found)(*(each[0] for each in found))


# ------------------------------------------------------------------------------- from poses to features


@pytest.mark.parametrize("fps", [25, 50, 120])
def test_wingbeats_of_known_frequency_amplitude_and_phase(fps):
    frequency = np.arange(2.0, 13.0) if fps < 100 else np.array([2.0, 5.5, 8.0, 12.0])
    found, phase = beating(frequency, fps, 1.6)
    np.testing.assert_allclose(found["beat_frequency"], np.broadcast_to(frequency[:, None], phase.shape), rtol=0.03)
    np.testing.assert_allclose(found["beat_amplitude"], 30, atol=0.6)
    late = (found["stroke_phase"] - np.degrees(phase) + 180) % 360 - 180
    assert np.abs(late).max() < 12
    assert np.abs(found["stroke_phase"]).max() <= 180
    np.testing.assert_allclose(found["beat_alias"], fps - found["beat_frequency"], rtol=1e-5)


def test_the_phase_is_0_with_the_wings_highest_and_90_in_the_downstroke():
    found, _ = beating([2.5], 50, 2, start=0.0)  # a beat lasts 20 frames
    phase, elevation = found["stroke_phase"][0, 40:60], found["wing_elevation"][0, 40:60]
    assert elevation.argmax() == 0
    assert phase[0] == pytest.approx(0, abs=3)
    assert phase[5] == pytest.approx(90, abs=3)
    assert elevation[4] > elevation[5] > elevation[6]
    assert abs(phase[elevation.argmin()]) == pytest.approx(180, abs=3)
    assert phase[15] == pytest.approx(-90, abs=3)


def test_a_fast_wingbeat_has_an_alias():
    """15 Hz in 25 frames/s look like 10 Hz."""
    found, _ = beating([15.0], 25, 1.6)
    np.testing.assert_allclose(found["beat_frequency"], 10, rtol=0.01)
    np.testing.assert_allclose(found["beat_alias"], 15, rtol=0.01)


def test_small_movements_of_the_wings_are_no_wingbeat():
    found, _ = beating([0.0, 5.0], 25, 1.6, amplitude=4.0)
    for name in NAMES:
        assert np.isnan(found[name]).all(), name


# ------------------------------------------------------------------------------- the spectrum alone


@pytest.mark.parametrize("fps", [24, 30, 59.94])
def test_other_frame_rates(fps):
    time_s = np.arange(int(2 * fps)) / fps
    found = rhythm(signal(time_s, 6.3), time_s)
    np.testing.assert_allclose(found.frequency_hz, 6.3, rtol=0.01)
    np.testing.assert_allclose(found.amplitude, 20, rtol=0.02)


def test_a_rhythm_that_becomes_faster():
    time_s = np.arange(200) / 50
    phase = 2 * np.pi * (4 * time_s + 0.5 * time_s**2)  # from 4 Hz to 8 Hz
    found = rhythm(20 * np.cos(phase), time_s)
    middle = (time_s > 0.5) & (time_s < 3.5)
    np.testing.assert_allclose(found.frequency_hz[middle], (4 + time_s)[middle], rtol=0.02)
    error = (found.phase_deg - np.degrees(phase) + 180) % 360 - 180
    assert np.abs(error[middle]).max() < 15


def test_gaps():
    """Frames without a pose have no rhythm; short gaps do not change that of the others, long gaps leave none.

    The camera pauses for 30 s before frame 80, and no window bridges the pause. The second bird has no pose.
    """
    time_s = np.arange(130) / 25
    time_s[80:] += 30
    values = signal(time_s, 6.0)
    values[[10, 11, 12, 30, 33, 34]] = np.nan
    values[55:65] = np.nan
    found = rhythms(np.stack([values, np.full(130, np.nan)]), time_s)
    unknown = np.isnan(found.frequency_hz[0])
    assert unknown[np.isnan(values)].all()
    assert set(np.flatnonzero(unknown[:45])) <= {10, 11, 12, 30, 33, 34}
    assert not unknown[105:].any()
    np.testing.assert_allclose(found.frequency_hz[0, ~unknown], 6, rtol=0.01)
    error = (found.phase_deg[0] - np.degrees(2 * np.pi * 6 * time_s + 1) + 180) % 360 - 180
    assert np.nanmax(np.abs(error)) < 5
    assert np.isnan(found.frequency_hz[1]).all()


def test_uneven_times():
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.025, 0.055, 80))
    found = rhythm(signal(time_s, 5.0), time_s)
    np.testing.assert_allclose(found.frequency_hz, 5, rtol=0.03)
    error = (found.phase_deg - np.degrees(2 * np.pi * 5 * time_s + 1) + 180) % 360 - 180
    assert np.abs(error).max() < 10


def test_a_window_with_few_poses_has_no_rhythm():
    time_s = np.arange(100) / 25
    values = np.full(100, np.nan)
    values[40:55] = signal(time_s, 6.0)[40:55]  # 0.6 s of a window of 1 s
    assert np.isnan(rhythm(values, time_s).frequency_hz).all()
    values[35:60] = signal(time_s, 6.0)[35:60]
    assert np.isfinite(rhythm(values, time_s).frequency_hz[35:60]).all()


def test_a_ramp_and_a_still_bird_have_no_rhythm():
    time_s = np.arange(100) / 25
    for values in (40 * time_s, np.full(100, 7.0)):
        assert np.isnan(rhythm(values, time_s).frequency_hz).all()


def test_a_rhythm_in_noise_and_on_a_trend():
    rng, time_s = np.random.default_rng(0), np.arange(100) / 25
    found = rhythm(signal(time_s, 6.0) + 30 * time_s + 5 * rng.normal(size=100), time_s)
    np.testing.assert_allclose(found.frequency_hz, 6, rtol=0.03)
    np.testing.assert_allclose(found.amplitude, 20, atol=4)


def test_too_slow_videos_have_no_rhythm():
    for fps in (1, 3):
        time_s = np.arange(60) / fps
        assert np.isnan(rhythm(signal(time_s, 0.3 * fps), time_s).frequency_hz).all()
    for frames in (0, 1, 2, 3):
        time_s = np.arange(frames) / 25
        assert rhythms(np.zeros((2, frames)), time_s).phase_deg.shape == (2, frames)


@pytest.mark.parametrize("frequency_hz", [0.8, 1.0, 12.4, 12.5])
def test_frequencies_that_cannot_be_measured_are_unknown(frequency_hz):
    """Below 2.2 cycles in a window of 2 s, or within a quarter of a cycle of half the frame rate (12.5 Hz)."""
    time_s = np.arange(75) / 25
    assert np.isnan(rhythm(signal(time_s, frequency_hz), time_s).frequency_hz).all()


def test_large_noise_is_no_rhythm():
    noise = 10 * np.random.default_rng(1).normal(size=(20, 75))
    found = rhythms(noise, np.arange(75) / 25)
    assert np.isfinite(found.frequency_hz).mean() < 0.01


@pytest.mark.parametrize("seconds", [0.04, 0.3, 0.6])
@pytest.mark.parametrize("back", [False, True])
def test_a_bird_that_raises_its_wings_once_does_not_beat_them(seconds, back):
    """The wings rise by 60 degrees, and stay there or fold again after one second."""
    time_s = np.arange(100) / 25
    values = 60 * np.clip((time_s - 1.5) / seconds, 0, 1)
    if back:
        values = values - 60 * np.clip((time_s - 2.5) / seconds, 0, 1)
    assert np.isnan(rhythm(values, time_s).frequency_hz).all()


@pytest.mark.filterwarnings("error")
def test_rounding_does_not_hide_a_pure_sinusoid():
    """The share of the variance that a pure sinusoid explains may exceed 1 by rounding."""
    time_s = np.arange(25) / 25
    for frequency_hz in np.arange(3, 10, 0.4):
        found = rhythm(20 * np.sin(2 * np.pi * frequency_hz * (time_s - 0.48)), time_s)
        np.testing.assert_allclose(found.frequency_hz, frequency_hz, rtol=0.05)


def test_wingbeats_in_a_video_whose_frame_rate_changes():
    """A beat of 3 Hz, 2 s at 25 frames/s and 4 s at 10 frames/s: the limit of half the frame rate follows."""
    time_s = np.concatenate([np.arange(50) / 25, 2 + np.arange(40) / 10])
    found = rhythm(signal(time_s, 3.0), time_s)
    np.testing.assert_allclose(found.frequency_hz[[*range(40), *range(60, 90)]], 3, rtol=0.03)
