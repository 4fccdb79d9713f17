"""What every format exports: some tracks and frames of a result, and its folder."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.projection import InImage, image_focal_px, in_image
from jaxfit.data.result_folder import OBSERVATIONS, named_footage, read_summary
from jaxfit.data.solution import Solution, load_solution, select_solution
from jaxfit.data.tracks import TrackQuality, frame_step, track_quality
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder, write_whole
from jaxfit.foundation.reading import json_text
from jaxfit.model.bird import Bird
from jaxfit.video.decoding import frame_times as times_of_frames
from jaxfit.video.reader import probe_video


def track_positions(solution: Solution, tracks: Sequence[int] | None, source: object) -> Int[np.ndarray, "M"]:
    """Return the positions of some tracks, in the order of the solution; None means all tracks.

    Raises:
        InputError: the solution lacks a track, or no track is named.
    """
    known = solution.track_id.tolist()
    if tracks is None:
        return np.arange(len(known))
    missing = [track for track in tracks if track not in known]
    if missing or not tracks:
        problem = f"has no track {missing[0]}" if missing else "needs at least one track"
        raise InputError(source, problem, f"its tracks are {_listed(known)}")
    return np.flatnonzero(np.isin(solution.track_id, list(tracks)))


def frame_positions(solution: Solution, frames: tuple[int | None, int | None], source: object) -> Int[np.ndarray, "L"]:
    """Return the positions of the frames from a first frame to a last frame, which is left out, as in Python.

    Args:
        solution: the solution.
        frames: number of the first frame and number after the last frame; None is the first or the last frame of the
            solution.
        source: the result, for messages.

    Raises:
        InputError: the solution has no frames, or lacks a frame at one end of the range.
    """
    numbers = solution.frame_index
    if not len(numbers):
        raise InputError(source, "has no frames", "give another result")
    first, last = int(numbers[0]), int(numbers[-1])
    start, stop = (first if frames[0] is None else frames[0]), (last + 1 if frames[1] is None else frames[1])
    chosen = np.flatnonzero((numbers >= start) & (numbers < stop))
    if start < first or stop > last + 1 or not len(chosen):
        raise InputError(source, f"lacks the frames {start}:{stop}", f"its frames are {first}:{last + 1}")
    return chosen


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:20]))
    return f"{shown}, …" if len(numbers) > 20 else shown or "none"


ON_LEDGE = "probability that the bird stands on the ledge, the plane z = 0 of the world"
"""Definition of `on_ledge` in an export."""
CONFIDENCE = (
    "confidence of the detected keypoint that the pose was fitted to, in [0, 1], as the keypoint network gives it; 0 "
    "where the keypoint was not detected; NaN where the result does not hold detections or has no pose"
)
"""Definition of the confidences of an export."""
SD = (
    "standard deviation of the fit (Laplace approximation): of image positions in pixels; of positions in space "
    "relative to the mean of the keypoints, because one camera does not observe distance and size; of rotations in "
    "radians about the axes of the rotated part. The terms of the fit treat errors of different keypoints as "
    "independent, so with detections of networks these values are too small: 3 to 4 times in a simulated scene"
)
"""Definition of the standard deviations of an export."""
TRIANGULATED = (
    "keypoint of the detections in the world, without the model, where two cameras agree; its standard deviation along "
    "the axes of the world is that of independent errors of pixels, from the residuals, and contains no error that the "
    "views share"
)
"""Definition of the triangulated keypoints of an export."""

FPS_RANGE = 0.001, 100_000
"""Smallest and largest frame rate that a user can give, frames per second."""


@dataclass(frozen=True, eq=False)
class Exported:
    """The chosen part of a result, with N tracks, T frames and K keypoints."""

    source: Path
    """Folder of the result, for messages."""
    solution: Solution
    bird: Bird
    observations: Observations | None
    """Detections of the same tracks and frames, in the same order; None if the result folder has none."""
    quality: Mapping[int, TrackQuality]
    """Track → quality of its detections over the whole result. Empty without detections."""
    metres_per_unit: float | None
    """Length of a model unit; None if unknown."""
    focal_px: float
    """Focal length of the image: that of the whole result, so that all exports of a result have one scene."""
    fps: float | None
    """Frames per second of the footage; None if unknown."""
    times_s: Float[np.ndarray, "T"]
    """Time of every frame in seconds: the stored times, or frame number / fps; NaN if unknown."""
    video: Path | None
    """The footage, which may have been moved; None if unknown."""

    def select(self, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"]) -> Exported:
        """Return M of the tracks and L of the frames, chosen by their positions."""
        solution = select_solution(self.solution, rows, columns)
        return replace(
            self,
            solution=solution,
            observations=None if self.observations is None else self.observations.select(rows, columns),
            quality={track: self.quality[track] for track in solution.track_id.tolist() if track in self.quality},
            times_s=self.times_s[columns],
        )

    @property
    def unit(self) -> str:
        """Unit of exported lengths: `m`, or `unit` (model unit) where the length of a model unit is unknown."""
        return "unit" if self.metres_per_unit is None else "m"

    @property
    def length(self) -> float:
        """Factor from model units to the unit of exported lengths."""
        return self.metres_per_unit or 1.0

    @property
    def confidence(self) -> Float[np.ndarray, "N T K"]:
        """The confidences as `CONFIDENCE` defines them."""
        valid = self.solution.valid[..., None]
        if self.observations is None:
            return np.full(self.solution.keypoints.px.shape[:3], np.nan, np.float32)
        return np.where(valid, self.observations.confidence, np.float32(np.nan))

    @property
    def keypoints_px(self) -> Float[np.ndarray, "N T K 2"]:
        """Projected keypoints in image pixels; NaN without a pose."""
        return np.where(self.solution.valid[..., None, None], self.solution.keypoints.px, np.float32(np.nan))

    @property
    def keypoints_3d(self) -> Float[np.ndarray, "N T K 3"]:
        """Keypoints in the camera frame of the image (`in_image`), in `unit`; NaN without a pose."""
        points = self.in_image.points(self.solution.keypoints.cam, np.asarray(self.solution.poses.scale))
        return (points * self.length).astype(np.float32)

    @property
    def keypoints_px_sd(self) -> Float[np.ndarray, "N T K 2"] | None:
        """Standard deviations of `keypoints_px`; None without error bars."""
        bars = self.solution.error_bars
        return None if bars is None else self._sd(bars.keypoints_px_cov)

    @property
    def keypoints_3d_sd(self) -> Float[np.ndarray, "N T K 3"] | None:
        """Standard deviations of `keypoints_3d` relative to their mean, in `unit`; None without error bars."""
        bars = self.solution.error_bars
        if bars is None:
            return None
        turn = self.in_image.turn[:, :, None]
        scale = (self.length * self.in_image.size / self.solution.poses.scale)[..., None, None]
        return self._sd(turn @ bars.keypoints_centred_cov @ turn.swapaxes(-1, -2)) * scale

    def _sd(self, covariance: np.ndarray) -> np.ndarray:
        variance = np.einsum("...ii->...i", covariance)
        variance = np.where(self.solution.valid[..., None, None], variance, np.nan)
        return np.sqrt(np.maximum(variance, 0))

    @cached_property
    def in_image(self) -> InImage:
        """The birds in the camera frame of the image, model units."""
        return in_image(self.solution, self.bird, self.focal_px)

    @property
    def sampling_fps(self) -> float:
        """Frames of the export per second: the frame rate divided by the step of the frame numbers."""
        return self.require_fps() / frame_step(self.solution.frame_index)

    @property
    def contact(self) -> Float[np.ndarray, "N T"] | None:
        """The probabilities that `ON_LEDGE` defines; NaN without a pose, None for a result without a ledge."""
        contact = self.solution.contact
        return None if contact is None else np.where(self.solution.valid, contact, np.float32(np.nan))

    @property
    def world_frame(self) -> str:
        """The axes of the world of a result."""
        return "world, as the cameras define it" if self.solution.contact is None else "world, z up"

    def require_world(self) -> Float[np.ndarray, "N T K 3"]:
        """Return the keypoints in the world, metres; NaN without a pose.

        Raises:
            InputError: the result is in no world.
        """
        world = self.solution.world
        if world is None:
            problem = "is in no world: one camera without a ledge does not measure places"
            raise InputError(self.source, problem, "place the birds by `jaxfit ledge`, or fit with --cameras")
        return np.where(self.solution.valid[..., None, None], world.keypoints_world_m, np.nan)

    def require_fps(self) -> float:
        """Return the frame rate of the footage.

        Raises:
            InputError: the frame rate is unknown.
        """
        if self.fps is None:
            raise InputError(self.source, "does not hold the frame rate of the footage", "give --fps, or --video")
        return self.fps

    def footage_times_s(self) -> Float[np.ndarray, "F"]:
        """Return the time of every frame of the footage, on the clock of `times_s`.

        The times are those of the footage if it can be read and its times are `times_s`. Otherwise they are `times_s`,
        linear between the frames of the result and by the frame rate before them, up to the last frame of the result.

        Raises:
            InputError: the frame rate is unknown.
        """
        numbers, times_s = self.solution.frame_index, self.times_s
        own = times_of_footage(self.video)
        if own is not None and len(own) > numbers[-1] and np.allclose(own[numbers], times_s, rtol=0, atol=1e-3):
            return own
        every = np.arange(numbers[-1] + 1)
        return np.interp(every, numbers, times_s) - np.maximum(numbers[0] - every, 0) / self.require_fps()

    def require_video(self) -> Path:
        """Return the footage.

        Raises:
            InputError: the footage is unknown.
        """
        if self.video is None:
            raise InputError(self.source, "does not name its footage, which this format links", "give --video")
        return self.video

    def require_poses(self) -> None:
        """Raise InputError if no chosen track has a pose in a chosen frame."""
        if not self.solution.valid.any():
            problem = "holds no pose in the chosen tracks and frames"
            raise InputError(self.source, problem, "choose other tracks and frames; `jaxfit tracks` lists them")


def open_result(
    folder: str | Path,
    tracks: Sequence[int] | None = None,
    frames: tuple[int | None, int | None] = (None, None),
    fps: float | None = None,
    metres_per_unit: float | None = None,
    video: str | Path | None = None,
) -> Exported:
    """Read a result folder for an export.

    Args:
        folder: folder of `jaxfit fit` or `jaxfit reconstruct`.
        tracks: ids of the tracks; None takes all tracks.
        frames: number of the first frame, and number after the last frame; None is an end of the result.
        fps: frame rate of the footage in frames per second. None takes the rate and the times of the result, or the
            rate of the video.
        metres_per_unit: length of a model unit in metres; None takes the length of the model, which may be unknown.
        video: the footage; None takes the footage that the result names.

    Raises:
        InputError: the folder holds no result, a track or frame is not in the result, a number is not positive, a
            length of a model unit is given for a result in a world, the video cannot be read or has other images, or
            the detections do not belong to the result.
    """
    folder = Path(folder)
    if fps is not None and not FPS_RANGE[0] <= fps <= FPS_RANGE[1]:
        raise InputError("--fps", f"is {fps}", f"give a number within {FPS_RANGE[0]} and {FPS_RANGE[1]:,}")
    if metres_per_unit is not None and not 0 < metres_per_unit < np.inf:
        raise InputError("--metres-per-unit", f"is {metres_per_unit}, not a positive number", "give a number above 0")
    solution, bird = load_solution(folder)
    if metres_per_unit is not None and solution.world is not None:
        remedy = f"remove --metres-per-unit: a model unit of this result is {bird.metres_per_unit:.6g} m"
        raise InputError("--metres-per-unit", "is given for a result in a world, which is in metres", remedy)
    rows = track_positions(solution, tracks, folder)
    columns = frame_positions(solution, frames, folder)
    observations, quality = _detections(folder, solution, bird)
    if video is None:
        video = named_footage(read_summary(folder))
        rate = fps or solution.fps
    else:
        video = Path(video)
        footage_fps = _rate_of(video, solution)
        rate = fps or solution.fps or footage_fps
    whole = Exported(
        source=folder,
        solution=solution,
        bird=bird,
        observations=observations,
        quality={track: quality[track] for track in solution.track_id.tolist() if track in quality},
        metres_per_unit=metres_per_unit or bird.metres_per_unit,
        focal_px=image_focal_px(solution),
        fps=rate,
        times_s=frame_times(solution, fps, rate, video),
        video=video,
    )
    return whole if tracks is None and frames == (None, None) else whole.select(rows, columns)


def stored_times(solution: Solution) -> Float[np.ndarray, "T"] | None:
    """Return the stored times of the frames, seconds; None if one is unknown or they do not increase."""
    stored = solution.timestamp_s
    increasing = stored is not None and np.isfinite(stored).all() and (np.diff(stored) > 0).all()
    return stored if increasing else None


def frame_times(
    solution: Solution, given: float | None, rate: float | None, video: Path | None = None
) -> Float[np.ndarray, "T"]:
    """Return the time of every frame: by the given rate, else stored, else of the footage, else by its rate."""
    numbers, stored = solution.frame_index, stored_times(solution)
    if given is None and stored is not None:
        return stored
    own = None if given is not None else times_of_footage(video)
    if own is not None and len(numbers) and len(own) > numbers[-1]:
        return own[numbers]
    return numbers / rate if rate else np.full(len(numbers), np.nan)


def times_of_footage(video: Path | None) -> Float[np.ndarray, "F"] | None:
    """Return the times of all frames of a video, seconds; None if they are unknown, or the video cannot be read."""
    if video is None or not video.is_file():
        return None
    try:
        times_s = times_of_frames(video, sys.maxsize)
    except InputError:
        return None
    return times_s if len(times_s) and (np.diff(times_s) > 0).all() else None


def _detections(folder: Path, solution: Solution, bird: Bird) -> tuple[Observations | None, dict[int, TrackQuality]]:
    """Return the detections of a result, with the tracks and frames of the solution, and the quality of the tracks."""
    path = folder / OBSERVATIONS
    if not path.is_file():
        return None, {}
    read = check_keypoints(read_coco(path), bird.keypoint_names, path)
    quality = {row.track_id: row for row in track_quality(read)}
    row = {track: n for n, track in enumerate(read.track_id.tolist())}
    column = {number: t for t, number in enumerate(read.frame_index.tolist())}
    tracks, frames = solution.track_id.tolist(), solution.frame_index.tolist()
    if not (set(tracks) <= set(row) and set(frames) <= set(column)):
        problem = "lacks tracks or frames of poses.npz, so it belongs to another result"
        raise InputError(path, problem, "remove it, or run the reconstruction again")
    order = np.array([row[track] for track in tracks], int)
    return read.select(order, np.array([column[number] for number in frames], int)), quality


def _rate_of(video: Path, solution: Solution) -> float | None:
    info = probe_video(video)
    sizes = solution.crops.image_size_px[solution.valid]
    if len(sizes) and (sizes != info.size_px).any():
        problem = f"is {info.size_px[0]}×{info.size_px[1]}, but the result has images of {sizes[0, 0]}×{sizes[0, 1]}"
        raise InputError(video, problem, "give the video that the result was fitted to")
    return info.fps


MARKER = "export.json"
"""Name of the file that every folder of an export contains."""


@contextmanager
def export_folder(
    exported: Exported, out: Path, overwrite: bool, names: dict[int, str], further: dict[str, Any]
) -> Iterator[Path]:
    """Write the folder of an export, completely or not at all, as a context manager; yields a temporary folder.

    Args:
        exported: the result.
        out: the folder.
        overwrite: replace an earlier export in the folder.
        names: track → name of its file; a track without a pose has no file.
        further: further entries of `export.json`; the body may add entries.

    Raises:
        InputError: the folder holds other files, or cannot be written.
    """
    with new_folder(out, overwrite, MARKER) as part:
        yield part
        facts = {"source_software": "jaxfit", "unit_of_lengths": exported.unit, "fps": exported.fps}
        tracks = describe_tracks(exported)
        for track, name in names.items():
            tracks[str(track)]["file"] = name
        write_whole(part / MARKER, json_text(facts | further | {"tracks": tracks}).encode())


def describe_tracks(exported: Exported) -> dict[str, dict[str, Any]]:
    """Return the status, the number of poses and the quality of every track, for JSON."""
    s = exported.solution
    tracks = {}
    for n, track in enumerate(s.track_id.tolist()):
        facts: dict[str, Any] = {"status": str(s.status[n]), "poses": int(s.valid[n].sum())}
        if track in exported.quality:
            facts["quality"] = exported.quality[track]._asdict()
        tracks[str(track)] = facts
    return tracks
