"""`describe`: the features of all birds of a result in every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxfit.behaviour.birds import Birds, Flock, times_known
from jaxfit.behaviour.registry import Feature, own_features
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent

CHUNK = 1000
"""Frames that are described at once."""
MARGIN_S = 2.0
"""Time before and after these frames that features may use, seconds."""
DRAWS = 24
"""Poses that are drawn from the error bars of a result; the relative error of a standard deviation is 15 %."""


@dataclass(frozen=True, eq=False)
class Description:
    """The features of N birds over T frames, which may be a part of the result that was described."""

    flock: Flock
    features: tuple[Feature, ...]
    values: Mapping[str, Float[np.ndarray, "N T"]]
    """Name of a feature → values; NaN where the value is not defined."""
    sd: Mapping[str, Float[np.ndarray, "N T"]]
    """Name of a feature → standard deviations, for features of one frame of a result with error bars."""
    missing: Mapping[str, str]
    """Name of a feature that the result does not have → why."""
    track_id: Int[np.ndarray, "M"]
    """All tracks of the result: a value of the unit `id` is a position in them."""

    def select(self, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"]) -> Description:
        """Return M of the birds in L of the frames, chosen by their positions; no value changes."""
        values, sd = (
            {name: array[rows][:, columns] for name, array in each.items()} for each in (self.values, self.sd)
        )
        return replace(self, flock=self.flock.select(rows, columns), values=values, sd=sd)

    def tracks(self, name: str) -> np.ndarray:
        """Return the tracks that a feature of the unit `id` names: an array (N, T) of int, None without a value."""
        positions = self.values[name]
        known = (positions >= 0) & (positions < len(self.track_id))
        found = np.full(positions.shape, None, object)
        found[known] = self.track_id[positions[known].astype(int)].tolist()
        return found

    def column(self, name: str) -> str:
        """Return the name of the column of a feature, with its unit."""
        return next(each for each in self.features if each.name == name).column(self.flock.unit)


def describe(
    flock: Flock,
    further: Sequence[Feature] = (),
    progress: ProgressTask = silent,
    own: Sequence[Feature] | None = None,
    deviations: bool = True,
) -> Description:
    """Compute jaxfit's own features and further features.

    The standard deviations are those of the features of `DRAWS` poses, drawn from the error bars. The error bars do not
    hold how the errors of different angles and frames belong together, so the angles are drawn as if they were
    independent, and features that compare frames have no standard deviation.

    Args:
        flock: the birds of a result.
        further: features of other packages.
        progress: reports frames.
        own: which of jaxfit's own features; None: all.
        deviations: compute standard deviations where the result has error bars.

    Raises:
        InputError: a feature raises an error, or does not return an array of N birds and T frames.
    """
    features = list(dict.fromkeys([*(own_features() if own is None else own), *further]))
    names = [each.name for each in features]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"feature {name!r}", "is defined twice", "give one of the functions another name")
    N, T = flock.solution.valid.shape
    # some frames, with what all frames show: whether times and the ledge are known
    sample = flock.birds(slice(0, min(T, 2)))
    sample = replace(
        sample,
        time_s=np.arange(float(len(sample.time_s))) + (0.0 if times_known(flock.time_s) else np.nan),
        contact=np.full(sample.contact.shape, 1.0 if np.isfinite(flock.contact).any() else np.nan),
    )
    missing = {each.name: reason for each in features if (reason := each.missing(sample)) is not None}
    present = [each for each in features if each.name not in missing]
    values = {each.name: np.full((N, T), np.nan, np.float32) for each in present}
    bars = deviations and flock.solution.error_bars is not None
    # the error bars of places are large along the viewing ray, and say nothing about the ledge
    single = [each for each in present if bars and each.of_one_frame and not {"ledge", "neighbours"} & {*each.needs}]
    sd = {each.name: np.full((N, T), np.nan, np.float32) for each in single}
    # the number of frames in `MARGIN_S` where the frame rate is highest
    margin = int(np.ceil(MARGIN_S / flock.step_s.min() - 1e-6)) if np.isfinite(flock.step_s).all() and T else 0
    with progress("Describing birds", T) as report_progress:
        for first in range(0, T, CHUNK):
            last = min(first + CHUNK, T)
            window = slice(max(first - margin, 0), min(last + margin, T))
            inside = slice(first - window.start, last - window.start)
            birds = flock.birds(window)
            for each in present:
                values[each.name][:, first:last] = _values(each, birds)[:, inside]
            if sd:
                for name, deviation in _deviations(flock, single, first, last).items():
                    sd[name][:, first:last] = deviation
            report_progress(last - first, "")
    return Description(flock, tuple(present), values, sd, missing, flock.solution.track_id)


def circular_mean(directions_deg: Float[np.ndarray, "M *A"]) -> Float[np.ndarray, "*A"]:
    """Return the circular mean over the first axis, −180 to 180 degrees."""
    return np.degrees(np.angle(np.exp(1j * np.radians(directions_deg)).mean(axis=0)))


def by_reason(missing: Mapping[str, str]) -> dict[str, list[str]]:
    """Return reason → the names that are missing for it."""
    reasons: dict[str, list[str]] = {}
    for name, reason in missing.items():
        reasons.setdefault(reason, []).append(name)
    return reasons


def _values(feature: Feature, birds: Birds) -> Float[np.ndarray, "N T"]:
    """Return the values of a feature, checked.

    Raises:
        InputError: the function raises an error or returns something else.
    """
    source = f"feature {feature.name!r}"
    try:
        with np.errstate(all="ignore"):
            found = np.asarray(birds.once(feature.function))
    except (Exception, SystemExit) as error:  # a foreign function may raise any exception, and may end Python
        problem = f"raised {type(error).__name__}: {error}"
        raise InputError(source, problem, "correct its function") from error
    if found.dtype.kind not in "biuf":
        problem = f"returned values of the type {found.dtype}, not numbers"
        raise InputError(source, problem, "return an array of numbers, or of true and false")
    if found.shape != birds.valid.shape:
        expected = " × ".join(map(str, birds.valid.shape))
        problem = f"returned an array of {' × '.join(map(str, found.shape)) or 'no axis'}"
        raise InputError(source, problem, f"return a value for each bird and frame: here {expected}")
    return np.where(birds.valid & np.isfinite(found), found.astype(np.float64), np.nan)


def _deviations(flock: Flock, features: Sequence[Feature], first: int, last: int) -> dict[str, np.ndarray]:
    """Return standard deviations of features of one frame; those of directions are circular."""
    rng = np.random.default_rng((0, first))
    drawn: dict[str, list[np.ndarray]] = {each.name: [] for each in features}
    for _ in range(DRAWS):
        birds = flock.birds(slice(first, last), rng)
        for each in features:
            drawn[each.name].append(_values(each, birds))
    bars = flock.solution.error_bars
    assert bars is not None
    known = np.isfinite(bars.global_orient_sd[:, first:last]).all(axis=-1)
    known &= np.isfinite(bars.body_pose_sd[:, first:last]).all(axis=(-2, -1))
    found = {}
    for each in features:
        values = np.stack(drawn[each.name])
        if each.circular:
            with np.errstate(all="ignore"):
                middle = circular_mean(values)
            values = (values - middle + 180) % 360 - 180
        found[each.name] = np.where(known, values.std(axis=0, ddof=1), np.nan)
    return found
