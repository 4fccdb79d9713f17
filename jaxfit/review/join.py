"""`join_results`: results of ranges of one video in one.

Which tracks of two ranges of frames are the same bird: by place and size, with a confidence. For a track that ends and
a track that begins `g` frames later, let d be the distance of the box centres in body lengths and s the change of the
logarithm of the size. Birds of the two ranges move by σ_g and change their size by τ_g (RMS) in `g` frames. The
evidence for the same bird is the ratio r of the density N(d; σ_g) N(s; τ_g) and the density of a new bird, which is
uniform over the image (in squared body lengths) and over one unit of the logarithm of the size. The confidence of a
pair is r / (1 + the sum of r over all pairs with one of the two tracks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.config.build import plain_config, with_values
from jaxfit.config.perception import TrackerConfig
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.observations import CELLS, MAPPINGS, Observations
from jaxfit.data.result_folder import OBSERVATIONS, POSES, read_summary
from jaxfit.data.solution import BODIES, Solution, write_solution
from jaxfit.data.tracks import frame_step, track_quality
from jaxfit.fitting.collect import summarise
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_replaceable, new_folder
from jaxfit.foundation.progress import Clock
from jaxfit.foundation.unfinished import differences
from jaxfit.model.bird import model_hash
from jaxfit.review.correct import DETECTION, Tracks, read_config, read_tracks

_FRAMES = ("frame_index", "image_size_px", "file_name", "timestamp_s")
_TIMES = ("frame_index", "timestamp_s")


def concatenate_observations(
    parts: Sequence[Observations], rows: Sequence[Int[np.ndarray, "n"]], track_id: Int[np.ndarray, "N"]
) -> Observations:
    """Return the observations of all frames.

    Args:
        parts: observations of ranges of frames, in the order of the frames.
        rows: for each part, the row of each of its tracks in the result.
        track_id: ids of the rows.
    """
    frames = np.cumsum([0, *(part.num_frames for part in parts)])
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _FRAMES}
    arrays |= {name: _in_rows([getattr(part, name) for part in parts], rows, len(track_id), 0) for name in CELLS}
    for name in MAPPINGS:
        arrays[name] = {
            (int(row[n]), int(first) + t): value
            for part, row, first in zip(parts, rows, frames, strict=False)
            for (n, t), value in getattr(part, name).items()
        }
    return replace(parts[0], track_id=track_id, **arrays)


def concatenate_solutions(
    parts: Sequence[Solution], rows: Sequence[Int[np.ndarray, "n"]], track_id: Int[np.ndarray, "N"]
) -> Solution:
    """Return the poses of all frames; arguments as of `concatenate_observations`.

    The status of a track is `ok` if the track has this status in all parts, and the losses of its parts are summed.
    Error bars are NaN in parts without error bars. The body of a track is that of the part whose data say most about
    it.
    """
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _TIMES}
    if any(part.error_bars is not None for part in parts):
        parts = [part.with_arrays(**part.cells(error_bars=True)) for part in parts]
    cells = [part.cells() for part in parts]
    for name in cells[0]:
        arrays[name] = _in_rows([part[name] for part in cells], rows, len(track_id), np.nan)
    loss = {term: np.full(len(track_id), np.nan) for term in dict.fromkeys(t for part in parts for t in part.loss)}
    statuses: list[list[str]] = [[] for _ in track_id]
    failures: dict[int, tuple[str, ...]] = {}
    for part, row in zip(parts, rows, strict=True):
        for n, joined in enumerate(row.tolist()):
            statuses[joined].append(str(part.status[n]))
            texts = part.failures.get(int(part.track_id[n]), ())
            if texts:
                failures[int(track_id[joined])] = (*failures.get(int(track_id[joined]), ()), *texts)
            for term, values in part.loss.items():
                if np.isfinite(values[n]):
                    loss[term][joined] = np.nansum([loss[term][joined], values[n]])
    status = np.array([_status(of_parts) for of_parts in statuses], "<U32")
    arrays |= _bodies(parts, rows, len(track_id))
    return parts[0].with_arrays(track_id=track_id, **arrays, loss=loss, status=status, failures=failures)


def _bodies(parts: Sequence[Solution], rows: Sequence[Int[np.ndarray, "n"]], count: int) -> dict[str, np.ndarray]:
    """Return the arrays of the bodies; none if no part has bodies."""
    known = [(part.arrays(), row) for part, row in zip(parts, rows, strict=True) if part.bodies is not None]
    if not known:
        return {}
    merged = {name: np.full((count, *known[0][0][name].shape[1:]), np.nan, np.float32) for name in BODIES}
    for arrays, row in known:
        before, frames = merged["body_frames"][row], arrays["body_frames"]
        better = ~np.isnan(frames) & ~(before >= frames)
        for name, values in merged.items():
            values[row[better]] = arrays[name][better]
    return merged


def _in_rows(parts: Sequence[np.ndarray], rows: Sequence[np.ndarray], count: int, absent: float) -> np.ndarray:
    """Return an array (N, T, …) of all tracks and frames; `absent`, 0 or False where a part lacks a track."""
    pieces = []
    for values, row in zip(parts, rows, strict=True):
        piece = np.full((count, *values.shape[1:]), absent if values.dtype.kind == "f" else 0, values.dtype)
        piece[row] = values
        pieces.append(piece)
    return np.concatenate(pieces, axis=1)


def _status(parts: Sequence[str]) -> str:
    """Return the status of a track from its statuses in all parts with the track."""
    fitted = [status for status in parts if status != "no usable frame"]
    if not fitted:
        return "no usable frame"
    return fitted[0] if len(set(fitted)) == 1 else "partly diverged"


MIN_CONFIDENCE = 0.5
"""Pairs with a lower confidence are different tracks."""
MIN_SPREAD = 0.05
"""Least σ and τ: the noise of boxes."""
MIN_PAIRS = 20
"""Number of pairs of frames that determine σ and τ."""
LARGEST_LOG_RATIO = 300.0


class Link(NamedTuple):
    """A track of the earlier range and a track of the later range that are one bird."""

    before: int
    """Position of the track in the earlier observations."""
    after: int
    """Position of the track in the later observations."""
    missing: int
    """Number of frames without the bird between the two ranges."""
    confidence: float
    """In [0.5, 1]."""


def link_tracks(before: Observations, after: Observations, max_missing: int) -> list[Link]:
    """Return the pairs of tracks that are one bird.

    Args:
        before: observations of the earlier frames.
        after: observations of later frames of the same video.
        max_missing: largest number of frames without the bird, in steps of the frame numbers.
    """
    step = frame_step(np.concatenate([before.frame_index, after.frame_index]))
    old, new = _boxes(before), _boxes(after)
    log_ratio = np.full((before.num_tracks, after.num_tracks), -np.inf)
    missing = np.zeros(log_ratio.shape, int)
    spread = cache(lambda gap: _spread((old, new), gap, step))
    for a, b in np.ndindex(log_ratio.shape):
        if not (old.present[a].any() and new.present[b].any()):
            continue
        end, start = int(np.flatnonzero(old.present[a])[-1]), int(np.flatnonzero(new.present[b])[0])
        gap = int(new.numbers[start] - old.numbers[end]) // step
        missing[a, b] = gap - 1
        if gap - 1 <= max_missing:
            width, height = after.image_size(b, start)
            places = (old.centre[a, end], old.size[a, end]), (new.centre[b, start], new.size[b, start])
            log_ratio[a, b] = _log_ratio(*places, spread(gap), width * height)
    gain = np.maximum(log_ratio, 0)
    ratio = np.exp(np.minimum(log_ratio, LARGEST_LOG_RATIO))
    total = ratio.sum(0) + ratio.sum(1, keepdims=True) - ratio
    links = []
    for a, b in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
        confidence = float(ratio[a, b] / (1 + total[a, b]))
        if confidence >= MIN_CONFIDENCE:
            links.append(Link(int(a), int(b), int(missing[a, b]), confidence))
    return links


class _Boxes(NamedTuple):
    """Boxes of N tracks over T frames."""

    numbers: Int[np.ndarray, "T"]
    present: Bool[np.ndarray, "N T"]
    centre: Float[np.ndarray, "N T 2"]
    """Image pixels."""
    size: Float[np.ndarray, "N T"]
    """Body length: the square root of the area, image pixels."""


def _boxes(observations: Observations) -> _Boxes:
    box = observations.box_px.astype(np.float64)
    size = np.sqrt(np.maximum(box[..., 2] * box[..., 3], 1.0))
    return _Boxes(observations.frame_index, observations.present, box[..., :2] + box[..., 2:] / 2, size)


def _spread(ranges: Sequence[_Boxes], gap: int, step: int) -> tuple[float, float]:
    """Return σ and τ after `gap` steps. Without enough pairs of frames, the variances grow linearly with the gap."""
    for lag in range(gap, 0, -1):
        changes = [_changes(boxes, lag * step) for boxes in ranges]
        moves, growths = np.concatenate([c[0] for c in changes]), np.concatenate([c[1] for c in changes])
        if len(growths) >= MIN_PAIRS:
            scale = np.sqrt(gap / lag)
            # RMS of the changes; variances grow linearly with the gap
            sigma, tau = scale * np.sqrt(np.mean(moves**2)), scale * np.sqrt(np.mean(growths**2))
            return max(sigma, MIN_SPREAD), max(tau, MIN_SPREAD)
    return MIN_SPREAD * np.sqrt(gap), MIN_SPREAD * np.sqrt(gap)


def _changes(boxes: _Boxes, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return moves (body lengths, for each axis) and changes of log size of all tracks between frames `lag` apart."""
    numbers = boxes.numbers
    later = np.minimum(np.searchsorted(numbers, numbers + lag), len(numbers) - 1)
    first = np.flatnonzero(numbers[later] == numbers + lag)
    second = later[first]
    both = boxes.present[:, first] & boxes.present[:, second]
    move = (boxes.centre[:, second] - boxes.centre[:, first]) / boxes.size[:, first, None]
    return move[both].ravel(), np.log(boxes.size[:, second] / boxes.size[:, first])[both]


def _log_ratio(
    end: tuple[np.ndarray, float], start: tuple[np.ndarray, float], spread: tuple[float, float], image_px2: float
) -> float:
    """Return log r for centre and size at the end of a track and at the start of another track."""
    (centre, size), (later_centre, later_size) = end, start
    length = np.sqrt(size * later_size)
    distance, growth = np.linalg.norm(later_centre - centre) / length, np.log(later_size / size)
    sigma, tau = spread
    same = -0.5 * (distance / sigma) ** 2 - np.log(2 * np.pi * sigma**2)
    same += -0.5 * (growth / tau) ** 2 - 0.5 * np.log(2 * np.pi * tau**2)
    return float(same + np.log(image_px2 / length**2))


_SAME_VIDEO = ("size_px", "frames", "fps")
_SHOWN = 3


class JoinedTrack(NamedTuple):
    """What became of a track of one part."""

    folder: str
    """The part."""
    track: int
    """Number of the track in the part."""
    first_frame: int
    last_frame: int
    joined: int
    """Number of the track in the joined result."""
    missing: int | None = None
    """Number of frames without the bird before this part; None if the track continues no track."""
    confidence: float | None = None
    """Confidence that the track continues the track of an earlier part, see `jaxfit.review.join`."""


class _Part(NamedTuple):
    folder: Path
    tracks: Tracks
    config: Any
    summary: dict[str, Any]

    @property
    def frames(self) -> np.ndarray:
        return self.tracks.observations.frame_index


def join_results(
    results: Sequence[str | Path], out: str | Path, bridge: int | None = None, overwrite: bool = False
) -> tuple[Solution, list[JoinedTrack]]:
    """Join the results of ranges of one video, and write the joined result.

    Poses and observations are copied. A track of a range continues a track of the ranges before it, if place and size
    agree (`jaxfit.review.join`) and the bird is missing in few frames. Continued tracks keep the number of
    the earlier track; other tracks get the next free number.

    Args:
        results: folders of `jaxfit reconstruct` with `--start` and `--stop`, in any order.
        out: folder for the joined result.
        bridge: largest number of frames without the bird, across a cut. None: the memory of the tracker.
        overwrite: replace an earlier result in `out`.

    Returns:
        The joined result, and what became of every track of every part.

    Raises:
        InputError: fewer than two results; a result without observations; overlapping frames; another video, model or
            config; or `out` is one of the results, holds other files or cannot be written.
    """
    out, clock = Path(out), Clock()
    folders = [Path(result) for result in results]
    if len(folders) < 2:
        raise InputError("join", "has one result", "name at least two results")
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise InputError(out, "is one of the results, which joining keeps", "choose another --out")
    if bridge is not None and bridge < 0:
        raise InputError("--bridge", f"is {bridge}", "give a number of frames, 0 or more")
    check_replaceable(out, overwrite, POSES)
    with clock("read"):
        parts = sorted((_read(folder) for folder in folders), key=lambda part: int(part.frames[0]))
    for earlier, later in pairwise(parts):
        _check_pair(earlier, later)
    tracker = getattr(getattr(parts[0].config, "track", None), "tracker", TrackerConfig())
    with clock("join"):
        table, rows, track_id = _follow(parts, tracker.memory if bridge is None else bridge)
        observations = concatenate_observations([part.tracks.observations for part in parts], rows, track_id)
        own_rows = [_solution_rows(part, row) for part, row in zip(parts, rows, strict=True)]
        solution = concatenate_solutions([part.tracks.solution for part in parts], own_rows, track_id)
    bird, first = parts[0].tracks.bird, parts[0].summary
    trust = _trust(parts)
    summary: dict[str, Any] = summarise(solution, bird, clock.seconds)
    summary |= {key: first[key] for key in DETECTION if key in first} | trust
    summary["quality"] = {row.track_id: row._asdict() for row in track_quality(observations)}
    # with the part, because the numbers are those of the tracks of the part
    corrections = [f"{part.folder}: {edit}" for part in parts for edit in part.summary.get("corrections", [])]
    if corrections:
        summary["corrections"] = corrections
    summary["joined"] = [row._asdict() for row in table]
    info = {key: "; ".join(value) if isinstance(value, list) else value for key, value in trust.items()}
    with new_folder(out, overwrite, marker=POSES) as part:
        write_coco(observations, part / OBSERVATIONS, info)
        write_solution(solution, bird, config_to_yaml(_config(parts)), summary, part)
    return solution, table


def _read(folder: Path) -> _Part:
    tracks, summary = read_tracks(folder), read_summary(folder)
    if not tracks.observations.num_frames:
        raise InputError(folder, "has no frames", "leave it out")
    failures = summary.get("failures")
    if isinstance(failures, dict):  # the solution that was read has none
        texts = {int(track): tuple(map(str, reasons)) for track, reasons in failures.items()}
        tracks = tracks._replace(solution=replace(tracks.solution, failures=texts))
    return _Part(folder, tracks, read_config(folder)[0], summary)


def _check_pair(earlier: _Part, later: _Part) -> None:
    """Check that two results belong to one video, model and config, and that their frames do not overlap.

    Raises:
        InputError: the results do not belong together.
    """
    if later.frames[0] <= earlier.frames[-1]:
        problem = f"begins at frame {later.frames[0]}, but {earlier.folder} ends at frame {earlier.frames[-1]}"
        raise InputError(later.folder, problem, "join ranges that do not overlap")
    described, other = (_described_video(part) for part in (earlier, later))
    for key in described:
        if described[key] != other[key]:
            problem = f"is the result of another video than {earlier.folder}: {key} {other[key]} instead of"
            raise InputError(later.folder, f"{problem} {described[key]}", "join results of one video")
    if model_hash(earlier.tracks.bird) != model_hash(later.tracks.bird):
        raise InputError(later.folder, f"has another model than {earlier.folder}", "reconstruct with one model")
    if earlier.summary.get("networks") != later.summary.get("networks"):
        raise InputError(later.folder, f"has other networks than {earlier.folder}", "reconstruct with one network")
    differing = list(differences(_compared(earlier.config), _compared(later.config)))
    if differing:
        problem = f"has another config than {earlier.folder}: {', '.join(differing[:_SHOWN])}"
        raise InputError(later.folder, problem, "reconstruct the ranges with one config")


def _described_video(part: _Part) -> dict[str, Any]:
    """Return the properties of the video that must agree between the parts; its folder may differ."""
    video = part.summary.get("video")
    video = video if isinstance(video, dict) else {}
    name = Path(str(video["file"])).name if "file" in video else None
    return {"name": name} | {key: video.get(key) for key in _SAME_VIDEO}


def _compared(config: Any) -> dict[str, Any]:
    """Return the settings that must agree between the parts: all except the range of frames, drawing and memory."""
    settings = plain_config(config)
    settings.pop("overlay", None)
    settings.get("fit", settings).pop("memory_gb", None)
    if "track" in settings:
        settings["track"].pop("threads")
        for end in ("start", "stop"):
            settings["track"]["frames"].pop(end)
    return settings


def _config(parts: Sequence[_Part]) -> Any:
    """Return the config of the joined result: that of the first part, with the whole range of frames."""
    config = parts[0].config
    if not hasattr(config, "track"):
        return config
    return with_values(config, {"track.frames.stop": parts[-1].config.track.frames.stop})


def _trust(parts: Sequence[_Part]) -> dict[str, Any]:
    """Return the lowest trust of all parts, with the reasons of all parts."""
    levels = [part.summary.get("trust") for part in parts]
    if not all(isinstance(level, str) for level in levels):
        return {}
    reasons = [reason for part in parts for reason in part.summary.get("trust_reasons", [])]
    return {"trust": "low" if "low" in levels else levels[0], "trust_reasons": list(dict.fromkeys(map(str, reasons)))}


def _follow(
    parts: Sequence[_Part], max_missing: int
) -> tuple[list[JoinedTrack], list[Int[np.ndarray, "n"]], Int[np.ndarray, "N"]]:
    """Return what became of every track, the row of every track of each part, and the number of every row."""
    table: list[JoinedTrack] = []
    rows: list[np.ndarray] = []
    track_id = np.zeros(0, np.int64)
    joined = None  # the observations of the parts so far
    for part in parts:
        later = replace(part.tracks.observations, masks={}, amodal_masks={})  # boxes are enough
        links = {} if joined is None else {link.after: link for link in link_tracks(joined, later, max_missing)}
        row = np.zeros(later.num_tracks, np.int64)
        for n, track in enumerate(later.track_id.tolist()):
            link = links.get(n)
            if link is None:
                row[n] = len(track_id)
                number = track if joined is None else int(track_id.max(initial=0)) + 1
                track_id = np.append(track_id, number)
            else:
                row[n] = link.before
            at = later.frame_index[later.present[n]]
            table.append(
                JoinedTrack(
                    str(part.folder),
                    track,
                    first_frame=int(at[0]) if len(at) else -1,
                    last_frame=int(at[-1]) if len(at) else -1,
                    joined=int(track_id[row[n]]),
                    missing=None if link is None else link.missing,
                    confidence=None if link is None else link.confidence,
                )
            )
        known, before = [row], [later]
        if joined is not None:
            known, before = [np.arange(joined.num_tracks), row], [joined, later]
        joined = concatenate_observations(before, known, track_id)
        rows.append(row)
    return table, rows, track_id


def _solution_rows(part: _Part, row: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return the rows of the tracks of the solution, whose order may differ from that of the observations."""
    position = {int(track): n for n, track in enumerate(part.tracks.observations.track_id)}
    return np.array([row[position[int(track)]] for track in part.tracks.solution.track_id], np.int64)
