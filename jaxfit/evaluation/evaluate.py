"""How well a result agrees with annotations: over all birds, for every bird, behaviour and keypoint."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.posed import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.evaluation import metrics
from jaxfit.evaluation.aggregation import COLUMNS, COLUMNS_KEYPOINT, Evaluation, metrics_of
from jaxfit.evaluation.bootstrap import BirdSums
from jaxfit.evaluation.keypoint_errors import correct_keypoints, squared_errors, squared_velocity_errors
from jaxfit.evaluation.matching import match
from jaxfit.evaluation.spatial import COLUMNS_3D, SpatialErrors
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent
from jaxfit.raster.zbuffer import hard_mask

__all__ = ["COLUMNS", "COLUMNS_3D", "Evaluation", "evaluate"]

_logger = logging.getLogger(__name__)

_REMEDY = "give the annotations of the same video"
_HARDLY = 0.05
"""Median IoU below which a result has nothing to do with its truth, however badly it was fitted."""


def evaluate(
    solution: Solution,
    bird: Bird,
    truth: Observations,
    progress: ProgressTask = silent,
    source: object = "truth",
    *,
    truth_solution: Solution | None = None,
    truth_bird: Bird | None = None,
    behaviours: Mapping[int, Sequence[tuple[int, str]]] | None = None,
) -> Evaluation:
    """Compare a result with annotations of the same video, matched by track id and frame number.

    Tracks that a tracker named are given the truth's ids by `match_tracks` first.

    PCK counts annotated keypoints, hidden ones included, within 5 and 10 % of the longer side of the annotated mask
    (of the box where there is no mask); IoU compares the mesh's hard mask with the annotated one, the whole bird's
    where that is known; me_p and me_v, of the same keypoints, are relative to the longer side of the mesh's mask.
    True poses add errors in space, also where nothing is annotated.

    Args:
        solution: the result.
        bird: its model.
        truth: the annotations.
        progress: told of every bird and frame.
        source: what the truth was read from, for messages.
        truth_solution: the true poses, in crops that are the real camera (see `SpatialErrors`).
        truth_bird: their model; None where it is the result's.
        behaviours: what each true bird does, by its track id: from which frame on, beginning with the first, and
            what (`read_behaviours`); None where that is not known.

    Raises:
        InputError: other keypoints than the model's, no track and frame in common, pictures of another size, true
            poses that are none, or a bird whose behaviour is not told.
    """
    truth = check_keypoints(truth, bird.keypoint_names, source)
    n_truth, t_truth, shared = match(solution, truth.track_id, truth.frame_index)
    annotated = shared & truth.present[n_truth, t_truth]
    measured = annotated & solution.valid
    if not measured.any():
        raise InputError(
            source,
            f"shares no bird with the result: tracks {_some(truth.track_id)}, frames {_some(truth.frame_index)} "
            f"against {_some(solution.track_id)}, {_some(solution.frame_index)}",
            _REMEDY,
        )
    _check_sizes(solution, truth, measured, (n_truth, t_truth), source)
    spatial = None
    if truth_solution is not None:
        spatial = SpatialErrors(solution, bird, truth_solution, truth_bird or bird, source)
    either = measured if spatial is None else measured | spatial.measured
    does = np.full(measured.shape, "") if behaviours is None else _behaviours(behaviours, solution, either, source)
    observed = truth.keypoints_px[n_truth, t_truth]
    annotated_points = (truth.confidence[n_truth, t_truth] > 0) & measured[..., None]
    overlap = np.full(measured.shape, np.nan)
    true_side, own_side = overlap.copy(), overlap.copy()
    posed = PosedBirds(solution, bird)
    faces = np.asarray(posed.faces)
    with progress("Measuring", int(measured.sum())) as report_progress:
        for n, t in np.argwhere(measured).tolist():
            at = int(n_truth[n, 0]), int(t_truth[t])
            mask = truth.whole_mask(*at)
            own = hard_mask(posed.vertices_screen(n, t), faces, *truth.image_size(*at))
            own_side[n, t] = metrics.longest_side_of_mask(own)
            true_side[n, t] = truth.box_px[at][2:].max() if mask is None else metrics.longest_side_of_mask(mask)
            if mask is not None:
                overlap[n, t] = metrics.iou(own, mask)
            report_progress(1, "")

    overlaps = overlap[np.isfinite(overlap)]
    if overlaps.size and np.median(overlaps) < _HARDLY:
        _logger.warning(
            "hardly any bird of the result lies where %s has one (median IoU %.2f): is it the truth of another video?",
            source,
            np.median(overlaps),
        )
    unmatched = solution.valid & ~shared
    if spatial is not None:
        unmatched &= ~spatial.measured

    picture = (solution.keypoints_px, observed, annotated_points)
    errors = {
        "pck@0.05": metrics.pck_per_image(*picture, true_side, 0.05)[..., None],
        "pck@0.10": metrics.pck_per_image(*picture, true_side, 0.10)[..., None],
        "iou": overlap[..., None],
        "me_p": squared_errors(*picture, own_side),
        "me_v": squared_velocity_errors(*picture, own_side, solution.frame_index),
        **(spatial.errors() if spatial else {}),
    }
    # an image's share of one keypoint is whether it is correct
    of_keypoints = errors | {
        "pck@0.05": correct_keypoints(*picture, true_side, 0.05),
        "pck@0.10": correct_keypoints(*picture, true_side, 0.10),
    }
    rows = np.flatnonzero(either.any(1)).tolist()
    sums = BirdSums.of(solution.track_id[rows].tolist(), {name: values[rows] for name, values in errors.items()})

    def count(what: np.ndarray) -> float:
        return float(what.sum())

    return Evaluation(
        overall=metrics_of(errors),
        tracks={
            int(solution.track_id[n]): {"frames": count(measured[n]), **metrics_of(errors, _only(n, measured.shape))}
            for n in rows
        },
        frames=int(measured.sum()),
        missing=int(truth.present.sum() - measured.sum()),
        unmatched=int(unmatched.sum()),
        frames_3d=int(spatial.measured.sum()) if spatial else 0,
        points_3d=spatial.points if spatial else "",
        intervals=sums.intervals(),
        behaviours={
            str(name): {
                "birds": count((either & (does == name)).any(1)),
                "frames": count(measured & (does == name)),
                **metrics_of(errors, does == name),
            }
            for name in np.unique(does[does != ""])
        },
        keypoints={
            name: {
                "count": count(annotated_points[..., k]),
                **metrics_of({column: of_keypoints[column][..., k : k + 1] for column in COLUMNS_KEYPOINT}),
            }
            for k, name in enumerate(bird.keypoint_names)
        },
        sums=sums,
    )


def _only(n: int, shape: tuple[int, ...]) -> Bool[np.ndarray, "N T"]:
    return np.broadcast_to((np.arange(shape[0]) == n)[:, None], shape)


def _behaviours(
    behaviours: Mapping[int, Sequence[tuple[int, str]]],
    solution: Solution,
    measured: Bool[np.ndarray, "N T"],
    source: object,
) -> np.ndarray:
    """What each bird does in each frame, (N, T) text; empty where nothing is measured."""
    does = np.full(measured.shape, "", dtype=object)
    for n, track in enumerate(solution.track_id.tolist()):
        if not measured[n].any():
            continue
        if track not in behaviours:
            raise InputError(source, f"does not say what bird {track} does", "give behaviours of all birds, or none")
        starts, names = zip(*behaviours[track], strict=True)
        at = np.searchsorted(starts, solution.frame_index, side="right") - 1
        does[n] = np.where(measured[n], np.array(names, dtype=object)[at], "")
    return does


def _check_sizes(
    solution: Solution, truth: Observations, measured: np.ndarray, at: tuple[np.ndarray, np.ndarray], source: object
) -> None:
    for n, t in np.argwhere(measured).tolist():
        own, true = tuple(solution.image_size_px[n, t].tolist()), truth.image_size(int(at[0][n, 0]), int(at[1][t]))
        if own != true:
            problem = (
                f"has track {solution.track_id[n]}, frame {solution.frame_index[t]} in a picture of "
                f"{true[0]}×{true[1]}, but the result was fitted to one of {own[0]}×{own[1]}"
            )
            raise InputError(source, problem, _REMEDY)


def _some(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:5])
    return f"[{shown}{', …' if len(numbers) > 5 else ''}]"
