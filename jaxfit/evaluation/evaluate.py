"""How well a result agrees with annotations: a row for every bird, and one for all."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxfit.errors import InputError
from jaxfit.evaluation import metrics
from jaxfit.evaluation.matching import match
from jaxfit.evaluation.spatial import COLUMNS_3D, SpatialErrors
from jaxfit.fitting.posed import PosedBirds
from jaxfit.fitting.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.observations import Observations, check_keypoints
from jaxfit.progress import ProgressTask, silent
from jaxfit.render import hard_mask

__all__ = ["COLUMNS", "COLUMNS_3D", "Evaluation", "evaluate"]

_logger = logging.getLogger(__name__)

COLUMNS = ("pck@0.05", "pck@0.10", "iou", "me_p", "me_v")
_REMEDY = "give the annotations of the same video"
_HARDLY = 0.05
"""Median IoU below which a result has nothing to do with its truth, however badly it was fitted."""


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a result; NaN where there is nothing to measure (no mask, no two frames in a row)."""

    overall: dict[str, float]
    """COLUMNS over all birds: PCK and IoU as means over images, me_p and me_v as RMS over keypoints; with true
    poses also COLUMNS_3D, which `SpatialErrors` defines."""
    tracks: dict[int, dict[str, float]]
    """The same for every track by its id, and the number of its frames as `frames`."""
    frames: int
    """Birds × frames measured."""
    missing: int
    """Annotated birds × frames that the result has no pose for, also those of tracks that it lacks; they enter no
    metric."""
    unmatched: int = 0
    """Poses × frames of the result whose track or frame the truth lacks; they enter no metric."""
    frames_3d: int = 0
    """Birds × frames measured in space."""
    points_3d: Literal["", "joints", "keypoints"] = ""
    """What was measured in space; empty without true poses."""


def evaluate(
    solution: Solution,
    bird: Bird,
    truth: Observations,
    progress: ProgressTask = silent,
    source: object = "truth",
    *,
    truth_solution: Solution | None = None,
    truth_bird: Bird | None = None,
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

    Raises:
        InputError: other keypoints than the model's, no track and frame in common, pictures of another size, or
            true poses that are none.
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
    observed = truth.keypoints_px[n_truth, t_truth]
    annotated_points = (truth.confidence[n_truth, t_truth] > 0) & measured[..., None]
    overlap = np.full(measured.shape, np.nan)
    true_side, own_side = overlap.copy(), overlap.copy()
    posed = PosedBirds(solution, bird)
    faces = np.asarray(posed.faces)
    with progress("Measuring", int(measured.sum())) as tick:
        for n, t in np.argwhere(measured).tolist():
            at = int(n_truth[n, 0]), int(t_truth[t])
            mask = truth.whole_mask(*at)
            own = hard_mask(posed.vertices_screen(n, t), faces, *truth.image_size(*at))
            own_side[n, t] = metrics.longest_side_of_mask(own)
            true_side[n, t] = truth.box_px[at][2:].max() if mask is None else metrics.longest_side_of_mask(mask)
            if mask is not None:
                overlap[n, t] = metrics.iou(own, mask)
            tick(1, "")

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

    def row(birds) -> dict[str, float]:
        predicted, seen, vis = solution.keypoints_2d[birds], observed[birds], annotated_points[birds]
        covered = overlap[birds][np.isfinite(overlap[birds])]
        return {
            "pck@0.05": metrics.pck(predicted, seen, vis, true_side[birds], 0.05),
            "pck@0.10": metrics.pck(predicted, seen, vis, true_side[birds], 0.10),
            "iou": float(covered.mean()) if covered.size else float("nan"),
            "me_p": metrics.me_p(predicted, seen, vis, own_side[birds]),
            "me_v": metrics.me_v(predicted, seen, vis, own_side[birds], solution.frame_index),
            **(spatial.row(birds) if spatial else {}),
        }

    tracks = {
        int(track): {"frames": float(measured[n].sum()), **row(slice(n, n + 1))}
        for n, track in enumerate(solution.track_id)
        if measured[n].any() or (spatial is not None and spatial.measured[n].any())
    }
    return Evaluation(
        row(slice(None)),
        tracks,
        int(measured.sum()),
        int(truth.present.sum() - measured.sum()),
        int(unmatched.sum()),
        int(spatial.measured.sum()) if spatial else 0,
        spatial.points if spatial else "",
    )


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
