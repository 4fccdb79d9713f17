"""`Truth`: annotations, exact poses, behaviours; tracks of a result ↔ tracks of the truth."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.data.formats import MARKER, TRUE_POSES, TRUTH
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.coco_records import Untracked
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.mask_files import mask_observations
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.masks import box_iou, box_of_keypoints
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution, load_solution
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.video.pictures import IMAGE_SUFFIXES


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about the birds of one video."""

    observations: Observations
    """The annotations."""
    solution: Solution | None = None
    """The exact poses, in crops that are the real camera (see `SpatialErrors`); None where they are not known."""
    bird: Bird | None = None
    """The model of the exact poses; None stands for the model of the result."""
    behaviours: Mapping[int, Sequence[tuple[int, str]]] | None = None
    """Track id → pairs of a first frame and the behaviour that begins there, in the order of frames; the first pair
    begins with frame 0. None where behaviours are not known."""
    source: object = "truth"
    """The file or folder of the truth, for error messages."""

    @classmethod
    def of(cls, truth: Truth | Observations) -> Truth:
        """Return the truth itself, or annotations as a truth without poses."""
        return truth if isinstance(truth, Truth) else cls(truth)


def read_truth(
    path: str | Path,
    video: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
    untracked: Untracked = "video",
) -> Truth:
    """Read the truth from a file of annotations, from a folder of masks or from the folder of a simulated scene.

    Args:
        path: a file of annotations, as for `read_observations`; a folder of pictures of masks, as for
            `mask_observations`; or the folder of a simulated scene, which holds the annotations as ``truth.json``, the
            exact poses as the result folder ``truth/`` and the behaviours in ``scene.json``.
        video: as for `read_observations`.
        size_px: as for `read_observations`.
        untracked: as for `read_observations`.

    Returns:
        The truth; without poses, model and behaviours for a file or for masks, and without behaviours for a scene
        without ``scene.json``.

    Raises:
        InputError: the file does not exist, the folder holds no truth, or a file cannot be read.
    """
    path = Path(path)
    if not os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises for names that are too long)
        return Truth(read_observations(path, video, size_px, untracked), source=path)
    if not (path / TRUTH).is_file():
        if any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir()):
            return Truth(mask_observations(path), source=path)
        remedy = "give a file of annotations, a folder of masks, or the folder of a scene that `jaxfit simulate` wrote"
        raise InputError(path, f"is a folder without {TRUTH} and without pictures of masks", remedy)
    if not (path / TRUE_POSES).is_dir():
        remedy = f"give {path / TRUTH} to compare in the image alone"
        raise InputError(path, f"holds no true poses (a folder {TRUE_POSES}/)", remedy)
    return Truth(read_coco(path / TRUTH), *load_solution(path / TRUE_POSES), read_behaviours(path), path)


def read_behaviours(path: str | Path) -> dict[int, list[tuple[int, str]]] | None:
    """Read the behaviours of the birds of a simulated scene.

    Args:
        path: as for `read_truth`.

    Returns:
        As `Truth.behaviours`; None for a COCO file and for a folder without ``scene.json``.

    Raises:
        InputError: ``scene.json`` cannot be read.
    """
    path = Path(path)
    if not (path / MARKER).is_file():
        return None
    behaviours = {}
    for track, entries in read_json(path / MARKER)["behaviour"].entries():
        pairs = [(entry["from_frame"].integer(0), entry["behaviour"].text()) for entry in entries]
        starts = [start for start, _ in pairs]
        if not track.isdecimal() or starts[:1] != [0] or starts != sorted(set(starts)):
            entries.fail("must be the behaviours of a track id, with from_frame increasing from 0")
        behaviours[int(track)] = pairs
    return behaviours


MIN_IOU = 0.5
"""A track and a bird agree in a frame where the boxes of their keypoints have at least this IoU."""
MIN_KEYPOINTS = 3
"""Fewest annotated keypoints of a box."""


def match(
    solution: Solution, track_id: Int[np.ndarray, "M"], frame_index: Int[np.ndarray, "L"]
) -> tuple[Int[np.ndarray, "N 1"], Int[np.ndarray, "T"], Bool[np.ndarray, "N T"]]:
    """Return the positions in the truth of the tracks and frames of a result.

    Args:
        solution: the result, N tracks over T frames.
        track_id: ids of the M tracks of the truth.
        frame_index: numbers of the L frames of the truth.

    Returns:
        Positions of the tracks, positions of the frames, and whether the truth has both the track and the frame.
        Together, the positions index an (M, L, …) array of the truth as an (N, T, …) array; positions are arbitrary
        where the truth lacks the track or the frame.
    """
    rows = {int(track): n for n, track in enumerate(track_id)}
    columns = {int(frame): t for t, frame in enumerate(frame_index)}
    n_truth = np.array([rows.get(int(track), -1) for track in solution.track_id], int)
    t_truth = np.array([columns.get(int(frame), -1) for frame in solution.frame_index], int)
    return n_truth[:, None], t_truth, (n_truth >= 0)[:, None] & (t_truth >= 0)


class Matching(NamedTuple):
    """Correspondence between the tracks of a result and the birds of the truth."""

    by: Literal["ids", "overlap"]
    """How the tracks were matched."""
    follows: dict[int, int]
    """Track of the result → the bird that the track follows, as a track id of the truth."""
    unmatched: list[int]
    """Tracks of the result that follow no bird."""
    missed: list[int]
    """Birds of the truth that no track follows."""


def match_tracks(
    solution: Solution, truth: Truth | Observations, how: Literal["auto", "ids", "overlap"] = "auto"
) -> tuple[Solution, Matching]:
    """Replace the track ids of a result by the ids of the birds that the tracks follow.

    A fit to annotations keeps the ids of the truth; a tracker makes ids of its own. With ``auto``, tracks are matched
    by id unless a track follows another bird than the bird with the track's id (see `match_by_overlap`). ``auto``
    also matches photographs by id, where every bird has an image of its own.

    Args:
        solution: the result.
        truth: the annotations.
        how: ``ids``, ``overlap`` or ``auto``.

    Returns:
        The result with the ids of the truth, for `evaluate`, and the matching. Unmatched tracks get ids that the truth
        does not use.

    Raises:
        InputError: the truth has other keypoints than the result, or photographs cannot be matched by overlap.
    """
    truth = Truth.of(truth)
    own, true = solution.track_id.tolist(), truth.observations.track_id.tolist()
    follows = {track: track for track in own if track in true}
    by: Literal["ids", "overlap"] = "ids"
    if how == "overlap" or (how == "auto" and not truth.observations.own_images):
        overlapping = match_by_overlap(solution, truth)
        if how == "overlap" or any(track != bird for track, bird in overlapping.items()):
            follows, by = overlapping, "overlap"
    unmatched = [track for track in own if track not in follows]
    missed = [bird for bird in true if bird not in follows.values()]
    if by == "overlap":
        unused = iter(range(max(true, default=0) + 1, max(true, default=0) + 1 + len(unmatched)))
        ids = [follows[track] if track in follows else next(unused) for track in own]
        solution = dataclasses.replace(solution, track_id=np.array(ids, np.int64))
    return solution, Matching(by, follows, unmatched, missed)


def match_by_overlap(solution: Solution, truth: Truth | Observations) -> dict[int, int]:
    """Match tracks and birds one-to-one, such that they agree in the greatest total number of frames.

    A track and a bird agree in a frame where the boxes around their keypoints have an IoU of at least ``MIN_IOU``.
    Both boxes enclose the keypoints that are annotated in this frame, at least three. A track can follow a bird only
    if the two agree in at least half of the frames that have both.

    Args:
        solution: the result.
        truth: the annotations.

    Returns:
        Track of the result → bird of the truth, for the matched tracks.

    Raises:
        InputError: the truth has other keypoints than the result, or every bird has a photograph of its own.
    """
    truth = Truth.of(truth)
    seen = check_keypoints(truth.observations, solution.keypoint_names, truth.source)
    if seen.own_images:
        remedy = "match the birds by their ids"
        raise InputError(truth.source, "holds photographs, in which no bird can be followed", remedy)
    _, at_truth, at_own = np.intersect1d(seen.frame_index, solution.frame_index, return_indices=True)
    annotated = seen.confidence[:, at_truth] > 0
    has_box = annotated.sum(-1) >= MIN_KEYPOINTS
    boxes_px = box_of_keypoints(seen.keypoints_px[:, at_truth], annotated)
    agree = np.zeros((len(solution.track_id), seen.num_tracks), int)
    for n, keypoints in enumerate(solution.keypoints.px[:, at_own]):
        both = has_box & solution.valid[n, at_own]
        own_boxes_px = box_of_keypoints(np.broadcast_to(keypoints, (*annotated.shape, 2)), annotated)
        overlapping = (both & (box_iou(own_boxes_px, boxes_px) >= MIN_IOU)).sum(1)
        agree[n] = np.where(2 * overlapping >= both.sum(1), overlapping, 0)
    pairs = zip(*linear_sum_assignment(agree, maximize=True), strict=True)
    return {int(solution.track_id[n]): int(seen.track_id[m]) for n, m in pairs if agree[n, m]}
