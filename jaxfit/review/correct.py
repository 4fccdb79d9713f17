"""`correct_tracks`: a result with corrected tracks, whose changed windows are fitted again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.reconstruct import ReconstructConfig, load_reconstruct_config
from jaxfit.data.flags import with_doubts
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.result_folder import CONFIG, OBSERVATIONS, POSES, read_summary
from jaxfit.data.solution import BODIES, Solution, load_solution, write_solution
from jaxfit.data.tracks import track_quality
from jaxfit.fitting.bodies import bodies_of
from jaxfit.fitting.collect import summarise, track_status
from jaxfit.fitting.fit import check_observations, fit_runs, windows_of
from jaxfit.fitting.windows import Windows, window_hash
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_replaceable, new_folder
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.reading import read_file
from jaxfit.model.bird import Bird
from jaxfit.review.edits import Edit, apply_edits
from jaxfit.review.points import Point


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

    Bodies: a track keeps the body of the track of the earlier result from which most of its equal windows come. Equal
    windows with another body are fitted again.

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
    before, after = check_observations(before, bird, source), check_observations(after, bird, source)
    old, new = windows_of(before, config, source), windows_of(after, config, source)
    rows = {window_hash(old, w): w for w in range(len(old))}
    source_row = np.array([rows.get(window_hash(new, w), -1) for w in range(len(new))])
    earlier, bodies, kept = bodies_of(solution, bird, config), {}, {}
    if earlier:
        kept = _origins(source_row, old, new)
        bodies = {track: earlier[origin] for track, origin in kept.items() if origin in earlier}
        origin_now = np.array([kept[track] for track in new.track_id.tolist()])
        source_row[(source_row >= 0) & (old.track_id[source_row] != origin_now)] = -1
    if config.overlap_frames:
        source_row = _with_equal_neighbours(source_row, old, new)
    touched = np.flatnonzero(source_row < 0)
    result = _empty(solution, after)
    if len(touched):
        result = fit_runs(after, bird, [config], None, progress, source, select=touched, bodies=bodies)[0]
    with_bars = result.error_bars is not None or solution.error_bars is not None
    copied = solution.cells(with_bars)
    arrays = {name: values.copy() for name, values in result.cells(with_bars).items()}
    counts = np.zeros((after.num_tracks, 2), int)  # windows with poses, windows that diverged
    loss = {term: np.full(after.num_tracks, np.nan) for term in result.loss or solution.loss}
    failures = {track: list(texts) for track, texts in result.failures.items()}
    for w in range(len(new)):
        n, at = int(new.track[w]), new.frame[w][new.present[w]]
        if source_row[w] >= 0:
            m = _row_of(solution, int(old.track_id[source_row[w]]))
            for name, values in copied.items():
                arrays[name][n, at] = values[m, at]
            if not solution.valid[m, at].any():
                first, last = after.frame_index[at[[0, -1]]]
                text = f"frames {first} to {last}: the window diverged in the earlier fit"
                failures.setdefault(int(after.track_id[n]), []).append(text)
        counts[n, 0 if arrays["valid"][n, at].any() else 1] += 1
    for n in range(after.num_tracks):
        windows_of_track = new.track == n
        origins = (
            {int(old.track_id[row]) for row in source_row[windows_of_track]}
            if (source_row[windows_of_track] >= 0).all()
            else set()
        )
        if (source_row[windows_of_track] < 0).all():
            for term in loss:
                loss[term][n] = result.loss[term][n] if term in result.loss else np.nan
        elif len(origins) == 1:
            track = origins.pop()
            if windows_of_track.sum() == (old.track_id == track).sum():  # all windows of one track
                for term in loss:
                    loss[term][n] = solution.loss[term][_row_of(solution, track)]
    merged = result.with_arrays(
        **arrays,
        **_merged_bodies(result, solution, kept),
        loss=loss,
        status=np.array([track_status(*count) for count in counts.tolist()], "<U32"),
        failures={track: tuple(texts) for track, texts in failures.items()},
    )
    # copied poses too: whether a pose is an outlier depends on all poses
    merged = with_doubts(merged, after, bird, progress)
    fitted = [(int(new.track_id[w]), *_ends(after, new, w)) for w in touched.tolist()]
    return Refit(merged, fitted, len(new))


def _origins(source_row: np.ndarray, old: Windows, new: Windows) -> dict[int, int]:
    """Return new track → the earlier track from which most of its equal windows come; without equal windows, itself."""
    origins = {}
    for track in dict.fromkeys(new.track_id.tolist()):
        rows = source_row[(new.track_id == track) & (source_row >= 0)]
        sources = Counter(old.track_id[rows].tolist())
        origins[track] = sources.most_common(1)[0][0] if sources else track
    return origins


def _merged_bodies(result: Solution, earlier: Solution, origins: Mapping[int, int]) -> dict[str, np.ndarray]:
    """Return the arrays of the bodies: those of the earlier result, and of the new result for its new tracks."""
    if earlier.bodies is None:
        return {}
    now, before, merged = result.arrays(), earlier.arrays(), {}
    for name in BODIES:
        empty = np.full((len(result.track_id), *before[name].shape[1:]), np.nan, np.float32)
        merged[name] = now.get(name, empty).copy()
        for n, track in enumerate(result.track_id.tolist()):
            origin = origins.get(track)
            if origin is not None and origin in earlier.track_id:
                row = _row_of(earlier, origin)
                if np.isfinite(before["body_frames"][row]):
                    merged[name][n] = before[name][row]
    return merged


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
    for name, values in solution.cells().items():
        filler = np.nan if values.dtype.kind == "f" else 0
        arrays[name] = np.full((count, *values.shape[1:]), filler, values.dtype)
    status = np.full(count, "no usable frame")
    arrays |= dict.fromkeys(BODIES)
    return solution.with_arrays(**arrays, track_id=observations.track_id, status=status, loss={}, failures={})


def _row_of(solution: Solution, track: int) -> int:
    return int(np.flatnonzero(solution.track_id == track)[0])


def _ends(observations: Observations, windows: Windows, w: int) -> tuple[int, int]:
    at = windows.frame[w][windows.present[w]]
    return int(observations.frame_index[at[0]]), int(observations.frame_index[at[-1]])


DETECTION = ("video", "networks", "segmenter", "segmenter_reason", "keypoint_names")
"""Entries of the summary about the video and the networks."""
_KEPT = (*DETECTION, "trust", "trust_reasons", "trust_signals", "joined")
"""Entries of the summary that corrections do not change."""


class Tracks(NamedTuple):
    """A result with the observations that it was fitted to."""

    solution: Solution
    bird: Bird
    observations: Observations


def read_tracks(result: str | Path, observations: str | Path | None = None) -> Tracks:
    """Read a result and its observations.

    Args:
        result: folder of `jaxfit reconstruct` or `jaxfit fit`.
        observations: the file that `jaxfit fit` was given; None takes `observations.json` of the folder.

    Raises:
        InputError: the files cannot be read, or do not belong together.
    """
    folder = Path(result)
    solution, bird = load_solution(folder)
    if solution.world is not None:
        problem = "is in a world, where tracks cannot be corrected or joined"
        remedy = (
            "correct a result without a world and run `jaxfit ledge` after it; or correct the observations of each "
        )
        raise InputError(folder, problem, remedy + "camera, or give --match, and fit again")
    path = folder / OBSERVATIONS if observations is None else Path(observations)
    if observations is None and not path.is_file():
        problem = f"holds no {OBSERVATIONS}, because `jaxfit fit` does not copy the observations"
        raise InputError(folder, problem, "give the observations of the fit by --observations")
    read = check_keypoints(read_observations(path), bird.keypoint_names, path)
    same = np.array_equal(read.frame_index, solution.frame_index)
    if not (same and np.array_equal(np.sort(read.track_id), np.sort(solution.track_id))):
        raise InputError(path, f"has other tracks or frames than {folder}", "give the file that was fitted")
    return Tracks(solution, bird, read)


def correct_tracks(
    result: str | Path,
    out: str | Path,
    edits: Sequence[Edit | Point],
    observations: str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressTask = silent,
) -> Refit:
    """Correct the tracks of a result, fit the windows that change, and write the new result.

    The folder holds the files of `jaxfit fit` and the corrected `observations.json`. `corrections` in `summary.json`
    lists the edits.

    Args:
        result: folder of the earlier result, which stays as it is.
        out: folder for the new result.
        edits: the corrections, one after the other.
        observations: the observations of the earlier result, see `read_tracks`.
        overwrite: replace an earlier result in `out`.
        progress: shows progress.

    Raises:
        InputError: as `read_tracks`, `apply_edits` and `jaxfit.fit`; or `out` is the folder of the earlier result,
            holds other files or cannot be written.
    """
    folder, out, start = Path(result), Path(out), time.perf_counter()
    if out.resolve() == folder.resolve():
        raise InputError(out, "is the result itself, which corrections keep", "choose another --out")
    check_replaceable(out, overwrite, POSES)
    tracks = read_tracks(folder, observations)
    corrected = apply_edits(tracks.observations, edits, folder)
    config, config_text = read_config(folder)
    fit_config = config.fit if isinstance(config, ReconstructConfig) else config
    done = refit(tracks.solution, tracks.observations, corrected, tracks.bird, fit_config, progress, folder)
    summary: dict[str, Any] = summarise(done.solution, tracks.bird, {"fit": time.perf_counter() - start})
    earlier = read_summary(folder)
    summary |= {key: value for key, value in earlier.items() if key in _KEPT}
    summary["quality"] = {row.track_id: row._asdict() for row in track_quality(corrected)}
    summary["corrections"] = [*earlier.get("corrections", []), *map(str, edits)]
    with new_folder(out, overwrite, marker=POSES) as part:
        write_coco(corrected, part / OBSERVATIONS)
        write_solution(done.solution, tracks.bird, config_text, summary, part)
    return done


def read_config(folder: Path) -> tuple[FitConfig | ReconstructConfig, str]:
    """Return the config of a result, of a fit or of a reconstruction, and the text of its file."""
    path = folder / CONFIG
    text = read_file(path, "a config").decode("utf-8", "replace")
    is_reconstruction = any(line.startswith("fit:") for line in text.splitlines())
    return (load_reconstruct_config(path) if is_reconstruction else load_config(path)), text
