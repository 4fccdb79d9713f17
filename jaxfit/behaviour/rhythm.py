"""Frequency, amplitude and phase of a rhythmic movement, in windows of time."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import lombscargle

from jaxfit.behaviour.birds import whole_frames

WINDOWS_S = 1.0, 2.0
"""Lengths of the windows, seconds: the long window counts where the short window shows no rhythm."""
CYCLES = 2.2
"""Cycles in a window below which a frequency cannot be measured: a single movement has fewer."""
SHARE = 0.5
"""Share of the variance of a window that one sinusoid explains, from which the movement is rhythmic."""
FALSE_ALARM = 0.01
"""Probability that the best sinusoid explains as much of noise, below which the movement is rhythmic."""
STEP = 0.2
"""Distance of the tried frequencies, in cycles per window."""
LOWEST_HZ = 0.3
"""Lowest frequency that is tried, so that a slow movement is not taken for the slowest rhythm."""
HOP_S = 0.04
"""Time between windows, seconds, if frames are closer."""


class Rhythm(NamedTuple):
    """A rhythmic movement of N birds in T frames; NaN where the movement is not rhythmic."""

    frequency_hz: Float[np.ndarray, "N T"]
    amplitude: Float[np.ndarray, "N T"]
    """Half of the range of the fitted sinusoid, in the unit of the signal."""
    phase_deg: Float[np.ndarray, "N T"]
    """0 at the largest value, 180 at the smallest value; 0 to 360."""


def rhythm_of(
    signal: Float[np.ndarray, "N T"],
    time_s: Float[np.ndarray, "T"],
    step_s: Float[np.ndarray, "T"],
    interval_s: float,
    min_amplitude: float,
    first: int = 0,
) -> Rhythm:
    """Return the rhythm of a signal around each frame, by least squares spectra of windows of `WINDOWS_S`.

    A window with a Hann taper is fitted by a constant and one sinusoid of each frequency (the generalised Lomb-Scargle
    periodogram), so that gaps and uneven frames are allowed. The frequency with the largest share of the variance
    counts, if this share is at least `SHARE` and larger than that of noise (`FALSE_ALARM`), and if the amplitude is at
    least `min_amplitude`. Frequencies of less than `CYCLES` per window, or within a quarter of a cycle per window of
    half the frame rate, cannot be measured. Faster movements look like slower movements: a frequency f above half the
    frame rate appears as fps − f.

    Args:
        signal: values, NaN where unknown.
        time_s: time of each frame.
        step_s: usual time between frames around each frame (`usual_steps`).
        interval_s: usual time between frames of the whole video; NaN for one frame.
        min_amplitude: smallest amplitude, in the unit of the signal.
        first: number of the first frame, so that the windows of parts of a video are those of the whole video.

    Source: Zechmeister and Kürster 2009, *The generalised Lomb-Scargle periodogram*, equations 4, 14 and 24.
    """
    found = Rhythm(*(np.full(signal.shape, np.nan) for _ in Rhythm._fields))
    hop = int(whole_frames(HOP_S, np.array(interval_s))) if np.isfinite(interval_s) else 1
    for n, values in enumerate(signal):
        for t in range(-(first % hop), len(time_s), hop):
            hops = slice(max(t, 0), t + hop)
            for window_s in WINDOWS_S:
                step = float(step_s[hops.start])
                measured = _in_window(values, time_s, t, hops, window_s, step, min_amplitude)
                if measured is not None:
                    for array, value in zip(found, measured, strict=True):
                        array[n, hops] = np.where(np.isfinite(values[hops]), value, np.nan)
                    break
    return found


def _in_window(
    values: np.ndarray,
    time_s: np.ndarray,
    t: int,
    hops: slice,
    window_s: float,
    interval_s: float,
    min_amplitude: float,
) -> tuple[float, float, np.ndarray] | None:
    """Return frequency, amplitude and phases of the rhythm in a window around frame t; None without a rhythm."""
    highest = 0.5 / interval_s - 0.25 / window_s
    if not highest > CYCLES / window_s:
        return None
    half = int(whole_frames(window_s / 2, np.array(interval_s)))
    near = np.arange(max(t - 2 * half, 0), min(t + 2 * half + 1, len(time_s)))
    around = values[near]
    if not np.fmax.reduce(around) - np.fmin.reduce(around) >= 2 * min_amplitude:  # most windows, so at once
        return None
    near = near[np.isfinite(values[near]) & (np.abs(time_s[near] - time_s[hops.start]) <= window_s)]
    # two thirds of the frames of a window, so that a gap is no rhythm
    least = 2 * (2 * half + 1) // 3
    if len(near) < least:
        return None
    # at the ends of a track, the window lies beside the frame
    start = int(np.clip(t - half, near[0], max(near[-1] - 2 * half, near[0])))
    at = near[(near >= start) & (near <= start + 2 * half)]
    if len(at) < least or np.ptp(values[at]) < 2 * min_amplitude:
        return None
    measured = _sinusoid(time_s[at], values[at], highest, time_s[hops], window_s)
    return None if measured is None or measured[1] < min_amplitude else measured


def _sinusoid(
    time_s: np.ndarray, values: np.ndarray, highest: float, at_s: np.ndarray, window_s: float
) -> tuple[float, float, np.ndarray] | None:
    """Return frequency, amplitude and the phases at some times of the sinusoid that explains most; None if little."""
    middle = (time_s[0] + time_s[-1]) / 2
    time_s = np.round(time_s - middle, 9)  # most windows then have the same times
    spectrum = _spectrum(time_s.tobytes(), highest, window_s)
    x, weights, frequency = time_s / window_s, spectrum.weights, spectrum.frequency
    # without the line of weighted least squares
    flat, beside = (each - weights @ each / weights.sum() for each in (values, x))
    flat -= beside * (weights @ (beside * flat)) / (weights @ beside**2)
    share = spectrum.share(flat)
    best = int(np.argmax(share))
    # the number of independent values under the taper, and of independent frequencies
    count, tried = weights.sum() ** 2 / (weights**2).sum(), frequency[-1] * window_s
    noise = tried * max(1 - share[best], 0) ** max((count - 3) / 2, 0)
    inside = 0 < best < len(share) - 1 and frequency[best] >= CYCLES / window_s
    if not (inside and share[best] >= SHARE and noise < FALSE_ALARM):
        return None
    left, top, right = share[best - 1 : best + 2]
    peak = frequency[best] + (left - right) / (2 * (left - 2 * top + right)) * (frequency[1] - frequency[0])
    how = {"weights": weights, "floating_mean": True}
    fitted = lombscargle(time_s, flat, np.array([2 * np.pi * peak]), normalize="amplitude", **how)
    wave = np.ravel(fitted)[0]
    phase = np.degrees(2 * np.pi * peak * (at_s - middle) - np.angle(wave)) % 360
    return float(peak), float(np.abs(wave)), phase


class _Spectrum(NamedTuple):
    """The generalised Lomb-Scargle periodogram of L times at F frequencies, except for the values.

    SciPy would compute the sinusoids again for every window.
    """

    weights: Float[np.ndarray, "L"]
    frequency: Float[np.ndarray, "F"]
    waves: Float[np.ndarray, "F 2 L"]
    """Cosine and sine without their weighted means, times the weights."""
    inverse: Float[np.ndarray, "F 2 2"]
    """Inverse of their weighted products."""

    def share(self, values: Float[np.ndarray, "L"]) -> Float[np.ndarray, "F"]:
        """Return the share of the variance of values of mean 0 that the sinusoid of each frequency explains."""
        product = self.waves @ values
        explained = np.einsum("fi,fij,fj->f", product, self.inverse, product)
        return explained / (self.weights @ values**2)


@lru_cache(64)
def _spectrum(times: bytes, highest: float, window_s: float) -> _Spectrum:
    """Return the spectrum of times (float64, seconds from the middle of the window) up to a frequency."""
    time_s = np.frombuffer(times)
    weights = np.cos(np.pi * time_s / window_s / 1.1) ** 2 + 1e-6
    frequency = np.arange(LOWEST_HZ, highest, STEP / window_s)
    angle = 2 * np.pi * frequency[:, None] * time_s
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    waves -= waves @ weights[:, None] / weights.sum()
    weighted = waves * weights
    return _Spectrum(weights, frequency, weighted, np.linalg.inv(weighted @ waves.swapaxes(1, 2)))
