"""`join_results`: the results of ranges of one video as one result, with the identities of birds across the cuts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from jaxfit.clock import Clock
from jaxfit.config.build import plain_config
from jaxfit.config.paths import with_values
from jaxfit.config.perception import TrackerConfig
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.corrections.concatenate import concatenate_observations, concatenate_solutions
from jaxfit.corrections.continuity import link_tracks
from jaxfit.corrections.correct import MARKER, OBSERVATIONS, Tracks, read_config, read_summary, read_tracks
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.solution import Solution, write_solution
from jaxfit.data.track_quality import track_quality
from jaxfit.errors import InputError
from jaxfit.fitting.summary import summarise
from jaxfit.model.describe import model_hash
from jaxfit.storage.files import check_replaceable, new_folder
from jaxfit.storage.parts import differences

__all__ = ["JoinedTrack", "join_results"]

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
    """Confidence that the track continues the track of an earlier part, see `jaxfit.corrections.continuity`."""


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
    agree (`jaxfit.corrections.continuity`) and the bird is missing in few frames. Continued tracks keep the number of
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
    check_replaceable(out, overwrite, MARKER)
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
    summary |= {key: first[key] for key in ("video", "networks") if key in first} | trust
    summary["quality"] = {row.track_id: row._asdict() for row in track_quality(observations)}
    summary["joined"] = [row._asdict() for row in table]
    info = {key: "; ".join(value) if isinstance(value, list) else value for key, value in trust.items()}
    with new_folder(out, overwrite, marker=MARKER) as part:
        write_coco(observations, part / OBSERVATIONS, info)
        write_solution(solution, bird, config_to_yaml(_config(parts)), summary, part)
    return solution, table


def _read(folder: Path) -> _Part:
    tracks, summary = read_tracks(folder), read_summary(folder)
    if not tracks.observations.num_frames:
        raise InputError(folder, "has no frames", "leave it out")
    failures = summary.get("failures")
    if isinstance(failures, dict):  # the solution that was read has none
        texts = {int(track): tuple(map(str, own)) for track, own in failures.items()}
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
    parts: Sequence[_Part], most_missing: int
) -> tuple[list[JoinedTrack], list[Int[np.ndarray, "n"]], Int[np.ndarray, "N"]]:
    """Return what became of every track, the row of every track of each part, and the number of every row."""
    table: list[JoinedTrack] = []
    rows: list[np.ndarray] = []
    track_id = np.zeros(0, np.int64)
    joined = None  # the observations of the parts so far
    for part in parts:
        own = part.tracks.observations
        links = {} if joined is None else {link.after: link for link in link_tracks(joined, own, most_missing)}
        row = np.zeros(own.num_tracks, np.int64)
        for n, track in enumerate(own.track_id.tolist()):
            link = links.get(n)
            if link is None:
                row[n] = len(track_id)
                number = track if joined is None else int(track_id.max(initial=0)) + 1
                track_id = np.append(track_id, number)
            else:
                row[n] = link.before
            at = own.frame_index[own.present[n]]
            ends = (int(at[0]), int(at[-1])) if len(at) else (-1, -1)
            more = (link.missing, link.confidence) if link else (None, None)
            table.append(JoinedTrack(str(part.folder), track, *ends, int(track_id[row[n]]), *more))
        known, before = [row], [own]
        if joined is not None:
            known, before = [np.arange(joined.num_tracks), row], [joined, own]
        joined = concatenate_observations(before, known, track_id)
        rows.append(row)
    return table, rows, track_id


def _solution_rows(part: _Part, row: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return the rows of the tracks of the solution, whose order may differ from that of the observations."""
    position = {int(track): n for n, track in enumerate(part.tracks.observations.track_id)}
    return np.array([row[position[int(track)]] for track in part.tracks.solution.track_id], np.int64)
