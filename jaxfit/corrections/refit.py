"""`refit`: fit the windows that corrections of tracks have changed, and keep all other poses as they are."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT, Solution
from jaxfit.fitting.collect import track_status
from jaxfit.fitting.fit import check_observations, fit_runs, windows_of
from jaxfit.fitting.windows import Windows, window_hash
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent

__all__ = ["Refit", "refit"]

_CELLS = tuple(name for name, (shape, _) in LAYOUT.items() if shape.startswith("N T"))


class Refit(NamedTuple):
    """The result of a refit."""

    solution: Solution
    fitted: list[tuple[int, int, int]]
    """Track, first and last frame number of every window that was fitted again."""
    windows: int
    """Number of all windows."""


def refit(
    solution: Solution,
    before: Observations,
    after: Observations,
    bird: Bird,
    config: FitConfig,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> Refit:
    """Fit the corrected observations, but only windows that no window of the earlier fit equals.

    Two windows are equal if they have the same frames, crops, filtered keypoints, confidences and masks. The fit of a
    window does not depend on other windows, so the result is that of a fit of all corrected observations. The poses of
    an equal window are copied bit by bit, also if its track has another number now. Where windows share frames
    (`overlap`), a window is copied only if its neighbours are equal too.

    Args:
        solution: the earlier result.
        before: the observations of the earlier result.
        after: the same frames with corrected tracks.
        bird: the model of the result.
        config: the config of the result.
        progress: shows progress.
        source: name of the observations in messages.

    Returns:
        The new result. The loss of a track with copied and fitted windows is NaN, because the result does not hold
        the loss of single windows.

    Raises:
        InputError: as `jaxfit.fit`.
    """
    before, after = (check_observations(each, bird, source) for each in (before, after))
    old, new = windows_of(before, config, source), windows_of(after, config, source)
    rows = {window_hash(old, w): w for w in range(len(old))}
    source_row = np.array([rows.get(window_hash(new, w), -1) for w in range(len(new))])
    if config.overlap_frames:
        source_row = _with_equal_neighbours(source_row, old, new)
    touched = np.flatnonzero(source_row < 0)
    result = _empty(solution, after)
    if len(touched):
        result = fit_runs(after, bird, [config], None, progress, source, select=touched)[0]
    arrays = {name: getattr(result, name).copy() for name in _CELLS}
    counts = np.zeros((after.num_tracks, 2), int)  # windows with poses, windows that diverged
    loss = {term: np.full(after.num_tracks, np.nan) for term in result.loss or solution.loss}
    failures = {track: list(texts) for track, texts in result.failures.items()}
    for w in range(len(new)):
        n, at = int(new.track[w]), new.frame[w][new.present[w]]
        if source_row[w] >= 0:
            m = _row_of(solution, int(old.track_id[source_row[w]]))
            for name in _CELLS:
                arrays[name][n, at] = getattr(solution, name)[m, at]
            if not solution.valid[m, at].any():
                first, last = after.frame_index[at[[0, -1]]]
                text = f"frames {first} to {last}: the window diverged in the earlier fit"
                failures.setdefault(int(after.track_id[n]), []).append(text)
        counts[n, 0 if arrays["valid"][n, at].any() else 1] += 1
    for n in range(after.num_tracks):
        own = new.track == n
        origins = {int(old.track_id[row]) for row in source_row[own]} if (source_row[own] >= 0).all() else set()
        if (source_row[own] < 0).all():
            for term in loss:
                loss[term][n] = result.loss[term][n] if term in result.loss else np.nan
        elif len(origins) == 1:
            track = origins.pop()
            if own.sum() == (old.track_id == track).sum():  # all windows of one track
                for term in loss:
                    loss[term][n] = solution.loss[term][_row_of(solution, track)]
    merged = replace(
        result,
        **arrays,
        loss=loss,
        status=np.array([track_status(*count) for count in counts.tolist()], "<U32"),
        failures={track: tuple(texts) for track, texts in failures.items()},
    )
    fitted = [(int(new.track_id[w]), *_ends(after, new, w)) for w in touched.tolist()]
    return Refit(merged, fitted, len(new))


def _with_equal_neighbours(source_row: np.ndarray, old: Windows, new: Windows) -> np.ndarray:
    """Keep the rows of windows whose neighbours in their track were their neighbours before; −1 for other windows.

    Where windows share frames, the poses of a window depend on its neighbours.
    """

    def neighbour(windows: Windows, w: int, step: int) -> int:
        inside = 0 <= w + step < len(windows)
        return w + step if inside and windows.track[w + step] == windows.track[w] else -1

    kept = source_row.copy()
    for w in np.flatnonzero(source_row >= 0).tolist():
        for step in (-1, 1):
            before, now = neighbour(old, int(source_row[w]), step), neighbour(new, w, step)
            if before != (source_row[now] if now >= 0 else -1) or (before < 0) != (now < 0):
                kept[w] = -1
    return kept


def _empty(solution: Solution, observations: Observations) -> Solution:
    """Return a result without poses for the tracks of the observations."""
    count = observations.num_tracks
    arrays = {}
    for name in _CELLS:
        values = getattr(solution, name)
        filler = np.nan if values.dtype.kind == "f" else 0
        arrays[name] = np.full((count, *values.shape[1:]), filler, values.dtype)
    status = np.full(count, "no usable frame")
    return replace(solution, **arrays, track_id=observations.track_id, status=status, loss={}, failures={})


def _row_of(solution: Solution, track: int) -> int:
    return int(np.flatnonzero(solution.track_id == track)[0])


def _ends(observations: Observations, windows: Windows, w: int) -> tuple[int, int]:
    at = windows.frame[w][windows.present[w]]
    return int(observations.frame_index[at[0]]), int(observations.frame_index[at[-1]])
