"""Evaluation of a result against the truth: overall, and by bird, behaviour and keypoint."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.evaluation import metrics
from jaxfit.evaluation.aggregation import COLUMNS, COLUMNS_KEYPOINT, Evaluation, metrics_of
from jaxfit.evaluation.bootstrap import BirdSums
from jaxfit.evaluation.keypoint_errors import correct_keypoints, squared_errors, squared_velocity_errors
from jaxfit.evaluation.mask_comparison import compare_masks
from jaxfit.evaluation.matching import match
from jaxfit.evaluation.spatial import COLUMNS_3D, SpatialErrors
from jaxfit.evaluation.truth import Truth
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent

__all__ = ["COLUMNS", "COLUMNS_3D", "Evaluation", "evaluate"]

_logger = logging.getLogger(__name__)

_REMEDY = "give the annotations of the same video"
_LEAST_MEDIAN_IOU = 0.05
"""Results with a smaller median IoU probably belong to another video: even a bad fit overlaps more."""


def evaluate(
    solution: Solution, bird: Bird, truth: Truth | Observations, progress: ProgressTask = silent
) -> Evaluation:
    """Compare a result with the truth about the same video, matched by track id and frame number.

    The track ids of a tracker differ from the ids of the truth; `match_tracks` replaces them.

    PCK counts annotated keypoints, hidden ones included, within 5 and 10 % of the longer side of the annotated mask
    (of the box where there is no mask). IoU compares the hard mask of the mesh with the annotated mask, which is the
    mask of the whole bird where that is known; otherwise the pixels of other birds' masks do not count, because the
    mesh may be hidden there. me_p and me_v are RMS errors of the same keypoints, relative to the
    longer side of the mask of the mesh; me_v is per frame of the result's file (see `metrics.me_v`). True poses add
    3D errors, also for birds and frames without an annotation.

    Args:
        solution: the result.
        bird: the model of the result.
        truth: the annotations, optionally with exact poses and behaviours (`Truth`, `read_truth`).
        progress: shows the progress over birds and frames.

    Raises:
        InputError: the truth has other keypoints than the model, no common track and frame, images of another size,
            exact poses that follow the birds, or no behaviour for a bird while it has behaviours of others.
    """
    truth = Truth.of(truth)
    source, seen = truth.source, check_keypoints(truth.observations, bird.keypoint_names, truth.source)
    n_truth, t_truth, shared = match(solution, seen.track_id, seen.frame_index)
    measured = shared & seen.present[n_truth, t_truth] & solution.valid
    _check_birds(solution, seen, measured, source)
    _check_sizes(solution, seen, measured, (n_truth, t_truth), source)
    spatial = None
    if truth.solution is not None:
        spatial = SpatialErrors(solution, bird, truth.solution, truth.bird or bird, source)
    either = measured if spatial is None else measured | spatial.measured
    behaviour = np.full(measured.shape, "")
    if truth.behaviours is not None:
        behaviour = _behaviour_of_frames(truth.behaviours, solution, either, source)
    masks = compare_masks(solution, bird, seen, measured, (n_truth, t_truth), progress)
    _warn_of_small_overlap(masks.iou, source)
    unmatched = solution.valid & ~shared
    if spatial is not None:
        unmatched &= ~spatial.measured

    annotated = (seen.confidence[n_truth, t_truth] > 0) & measured[..., None]
    keypoints = (solution.keypoints_px, seen.keypoints_px[n_truth, t_truth], annotated)
    errors = {
        "pck@0.05": metrics.pck_per_image(*keypoints, masks.true_side_px, 0.05)[..., None],
        "pck@0.10": metrics.pck_per_image(*keypoints, masks.true_side_px, 0.10)[..., None],
        "iou": masks.iou[..., None],
        "me_p": squared_errors(*keypoints, masks.predicted_side_px),
        "me_v": squared_velocity_errors(*keypoints, masks.predicted_side_px, solution.frame_index),
        **(spatial.errors() if spatial else {}),
    }
    rows = np.flatnonzero(either.any(1)).tolist()
    sums = BirdSums.of(solution.track_id[rows].tolist(), {name: values[rows] for name, values in errors.items()})
    return Evaluation(
        overall=metrics_of(errors),
        tracks={
            int(solution.track_id[n]): {
                "frames": float(measured[n].sum()),
                **metrics_of({name: values[n : n + 1] for name, values in errors.items()}),
            }
            for n in rows
        },
        frames=int(measured.sum()),
        missing=int(seen.present.sum() - measured.sum()),
        unmatched=int(unmatched.sum()),
        frames_3d=int(spatial.measured.sum()) if spatial else 0,
        points_3d=spatial.points if spatial else "",
        intervals=sums.intervals(),
        behaviours=_metrics_of_behaviours(behaviour, errors, measured, either),
        keypoints=_metrics_of_keypoints(bird.keypoint_names, errors, keypoints, masks.true_side_px),
        sums=sums,
    )


def _metrics_of_behaviours(
    behaviour: np.ndarray, errors: Mapping[str, np.ndarray], measured: np.ndarray, either: np.ndarray
) -> dict[str, dict[str, float]]:
    """Return the metrics of each behaviour; `either` also has the birds and frames with 3D errors only."""
    return {
        str(name): {
            "birds": float((either & (behaviour == name)).any(1).sum()),
            "frames": float((measured & (behaviour == name)).sum()),
            **metrics_of(errors, behaviour == name),
        }
        for name in np.unique(behaviour[behaviour != ""])
    }


def _metrics_of_keypoints(
    names: Sequence[str],
    errors: Mapping[str, np.ndarray],
    keypoints: tuple[np.ndarray, np.ndarray, np.ndarray],
    true_side_px: np.ndarray,
) -> dict[str, dict[str, float]]:
    """Return the metrics of each keypoint from the errors and from the arguments of `correct_keypoints`."""
    # the PCK of an image with a single keypoint is 1 or 0: whether this keypoint is correct
    errors = {
        **errors,
        "pck@0.05": correct_keypoints(*keypoints, true_side_px, 0.05),
        "pck@0.10": correct_keypoints(*keypoints, true_side_px, 0.10),
    }
    return {
        name: {
            "count": float(keypoints[2][..., k].sum()),
            **metrics_of({column: errors[column][..., k : k + 1] for column in COLUMNS_KEYPOINT}),
        }
        for k, name in enumerate(names)
    }


def _behaviour_of_frames(
    behaviours: Mapping[int, Sequence[tuple[int, str]]],
    solution: Solution,
    measured: Bool[np.ndarray, "N T"],
    source: object,
) -> np.ndarray:
    """Return the behaviour of each bird in each frame, (N, T) text; empty where nothing is measured."""
    behaviour = np.full(measured.shape, "", dtype=object)
    for n, track in enumerate(solution.track_id.tolist()):
        if not measured[n].any():
            continue
        if track not in behaviours:
            raise InputError(source, f"has no behaviour for bird {track}", "give behaviours of all birds, or of none")
        starts, names = zip(*behaviours[track], strict=True)
        at = np.searchsorted(starts, solution.frame_index, side="right") - 1
        behaviour[n] = np.where(measured[n], np.array(names, dtype=object)[at], "")
    return behaviour


def _check_birds(solution: Solution, seen: Observations, measured: np.ndarray, source: object) -> None:
    """Raise InputError if no bird is measured in any frame."""
    if not measured.any():
        raise InputError(
            source,
            f"shares no bird with the result: tracks {_some(seen.track_id)}, frames {_some(seen.frame_index)} "
            f"against {_some(solution.track_id)}, {_some(solution.frame_index)}",
            _REMEDY,
        )


def _check_sizes(
    solution: Solution, seen: Observations, measured: np.ndarray, at: tuple[np.ndarray, np.ndarray], source: object
) -> None:
    """Raise InputError where an image of the truth has another size than the image of the result."""
    for n, t in np.argwhere(measured).tolist():
        own, true = tuple(solution.image_size_px[n, t].tolist()), seen.image_size(int(at[0][n, 0]), int(at[1][t]))
        if own != true:
            problem = (
                f"has track {solution.track_id[n]}, frame {solution.frame_index[t]} in an image of "
                f"{true[0]}×{true[1]} pixels, but the result was fitted to an image of {own[0]}×{own[1]}"
            )
            raise InputError(source, problem, _REMEDY)


def _warn_of_small_overlap(iou: np.ndarray, source: object) -> None:
    overlaps = iou[np.isfinite(iou)]
    if overlaps.size and np.median(overlaps) < _LEAST_MEDIAN_IOU:
        _logger.warning(
            "the birds of the result hardly overlap the birds of %s (median IoU %.2f); check the video of the truth",
            source,
            np.median(overlaps),
        )


def _some(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:5])
    return f"[{shown}{', …' if len(numbers) > 5 else ''}]"
