"""How well a result agrees with annotations: a row for every bird, and one for all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxfit.errors import InputError
from jaxfit.evaluation import metrics
from jaxfit.fitting.posed import PosedBirds
from jaxfit.fitting.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.observations import Observations, check_keypoints
from jaxfit.progress import ProgressTask, silent
from jaxfit.render import hard_mask

__all__ = ["COLUMNS", "Evaluation", "evaluate"]

COLUMNS = ("pck@0.05", "pck@0.10", "iou", "me_p", "me_v")


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a result; NaN where there is nothing to measure (no mask, no two frames in a row)."""

    overall: dict[str, float]
    """COLUMNS over all birds: PCK and IoU as means over images, me_p and me_v as RMS over keypoints."""
    tracks: dict[int, dict[str, float]]
    """The same for every track by its id, and the number of its frames as `frames`."""
    frames: int
    """Birds × frames measured."""
    missing: int
    """Annotated birds × frames that the result has no pose for; they enter no metric."""


def evaluate(
    solution: Solution,
    bird: Bird,
    truth: Observations,
    progress: ProgressTask = silent,
    source: object = "truth",
) -> Evaluation:
    """Compare a result with annotations of the same video, matched by track and frame number.

    PCK counts visible keypoints within 5 and 10 % of the longer side of the annotated mask (of the box where
    there is no mask); IoU compares the mesh's hard mask with the annotated one; me_p and me_v are relative
    to the longer side of the mesh's mask.

    Raises:
        InputError: other keypoints than the model's, or no track and frame in common.
    """
    truth = check_keypoints(truth, bird.keypoint_names, source)
    columns = {int(frame): t for t, frame in enumerate(truth.frame_index)}
    rows = {int(track): n for n, track in enumerate(truth.track_id)}
    n_truth = np.array([rows.get(int(track), -1) for track in solution.track_id])
    t_truth = np.array([columns.get(int(frame), -1) for frame in solution.frame_index])
    shared = (n_truth >= 0)[:, None] & (t_truth >= 0)
    annotated = shared & truth.present[n_truth][:, t_truth]
    measured = annotated & solution.valid
    if not measured.any():
        raise InputError(
            source,
            f"shares no bird with the result: tracks {_some(truth.track_id)}, frames {_some(truth.frame_index)} "
            f"against {_some(solution.track_id)}, {_some(solution.frame_index)}",
            "give the annotations of the same video",
        )
    observed = truth.keypoints_px[n_truth][:, t_truth]
    visible = (truth.confidence[n_truth][:, t_truth] > 0) & measured[..., None]
    overlap = np.full(measured.shape, np.nan)
    true_side, own_side = overlap.copy(), overlap.copy()
    posed = PosedBirds(solution, bird)
    with progress("Measuring", int(measured.sum())) as tick:
        for n, t in np.argwhere(measured).tolist():
            at = int(n_truth[n]), int(t_truth[t])
            mask = truth.mask(*at)
            own = hard_mask(posed.vertices_screen(n, t), posed.faces, *truth.image_size(*at))
            own_side[n, t] = metrics.longest_side_of_mask(own)
            true_side[n, t] = truth.box_px[at][2:].max() if mask is None else metrics.longest_side_of_mask(mask)
            if mask is not None:
                overlap[n, t] = metrics.iou(own, mask)
            tick(1, "")

    def row(birds) -> dict[str, float]:
        predicted, seen, vis = solution.keypoints_2d[birds], observed[birds], visible[birds]
        covered = overlap[birds][np.isfinite(overlap[birds])]
        return {
            "pck@0.05": metrics.pck(predicted, seen, vis, true_side[birds], 0.05),
            "pck@0.10": metrics.pck(predicted, seen, vis, true_side[birds], 0.10),
            "iou": float(covered.mean()) if covered.size else float("nan"),
            "me_p": metrics.me_p(predicted, seen, vis, own_side[birds]),
            "me_v": metrics.me_v(predicted, seen, vis, own_side[birds], solution.frame_index),
        }

    tracks = {
        int(track): {"frames": float(measured[n].sum()), **row(slice(n, n + 1))}
        for n, track in enumerate(solution.track_id)
        if measured[n].any()
    }
    return Evaluation(row(slice(None)), tracks, int(measured.sum()), int((annotated & ~measured).sum()))


def _some(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:5])
    return f"[{shown}{', …' if len(numbers) > 5 else ''}]"
