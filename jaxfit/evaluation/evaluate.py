"""`evaluate`: a result against the truth, from per-keypoint errors to metrics."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import pydantic
from jaxtyping import Bool, Float

from jaxfit.data.flags import OK, WRONG_SHARE, flags
from jaxfit.data.mask_comparison import compare_masks
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.evaluation import metrics
from jaxfit.evaluation.bootstrap import BirdSums, Interval, Number
from jaxfit.evaluation.metrics import correct_keypoints, squared_errors, squared_velocity_errors
from jaxfit.evaluation.spatial import COLUMNS_3D, SpatialErrors
from jaxfit.evaluation.truth import Truth, match
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird

COLUMNS = ("pck@0.05", "pck@0.10", "iou", "me_p", "me_v")
"""Metrics in the image."""
COLUMNS_KEYPOINT = ("pck@0.05", "pck@0.10", "me_p", "me_v")
"""Metrics of one keypoint."""


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a result. NaN where nothing is measured: no mask, no two consecutive frames."""

    overall: dict[str, Number]
    """COLUMNS over all birds: PCK and IoU are means over images, me_p and me_v are RMS errors over keypoints. With
    true poses also COLUMNS_3D, which `SpatialErrors` defines."""
    tracks: dict[int, dict[str, Number]]
    """Track id → the same metrics of this track, and its number of measured frames as `frames`."""
    frames: int
    """Number of measured pairs of bird and frame."""
    missing: int
    """Number of annotated pairs of bird and frame without a pose in the result, including birds that the result
    lacks; no metric counts them."""
    unmatched: int = 0
    """Number of poses of tracks or frames that the truth lacks; no metric counts them."""
    frames_3d: int = 0
    """Number of pairs of bird and frame with 3D errors."""
    points_3d: Literal["", "joints", "keypoints"] = ""
    """The points of the 3D errors; empty without true poses."""
    intervals: dict[str, Interval] = field(default_factory=dict)
    """95 % intervals over birds of the metrics in `overall`, as `BirdSums.interval` defines them. The median of the
    orientation error has no interval, since it is not a mean. NaN for fewer than two birds."""
    behaviours: dict[str, dict[str, Number]] = field(default_factory=dict)
    """Behaviour → the metrics of `overall`, the number of `birds` that show the behaviour, and the number of
    `frames`; empty where behaviours are not known. A pair of frames belongs to the behaviour in the earlier frame, a
    triple of frames to the behaviour in the middle frame."""
    keypoints: dict[str, dict[str, Number]] = field(default_factory=dict)
    """Keypoint → COLUMNS_KEYPOINT of this keypoint over all birds, and the number of frames that annotate the
    keypoint as `count`."""
    flags: dict[str, float] = field(default_factory=dict)
    """Number of poses with a 3D error that are `wrong` (a joint wrong by more than `WRONG_SHARE` of the body length),
    `flagged` (`unsure` or `contradicted`), and both (`found`). Empty without true poses, or if the result has no
    flags."""
    wrong: dict[int, dict[str, Number]] = field(default_factory=dict)
    """Track id → the number of its wrong poses (see `flags`) as `count`, and the `frame` and the `error` (share of the
    body length) of the worst; the worst track first. Tracks without a wrong pose are left out."""
    sums: BirdSums = field(default_factory=lambda: BirdSums((), {}, {}))
    """Sums per bird, from which `paired_ratio` compares results of the same birds."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content as mappings and lists for JSON; the metrics over all birds are at the top level."""
        content = asdict(self)
        return content.pop("overall") | content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Evaluation:
        """Return the evaluation of a `to_dict`, also after JSON, where NaN is null and the track ids are text.

        Raises:
            ValueError: an entry is missing or has another form.
        """
        for name in ("frames_3d", "intervals", "behaviours", "keypoints", "sums"):  # which have a default
            if name not in content:
                raise ValueError(f"has no {name}")
        overall = {name: content[name] for name in (*COLUMNS, *COLUMNS_3D) if name in content}
        return pydantic.TypeAdapter(cls).validate_python({**content, "overall": overall})


def metrics_of(
    errors: Mapping[str, Float[np.ndarray, "N T _"]], where: Bool[np.ndarray, "N T"] | None = None
) -> dict[str, float]:
    """Return every metric of some errors.

    Args:
        errors: metric → the error of each bird, frame and point, as `BirdSums.of` takes it; NaN does not count.
        where: the birds and frames that count; None for all.

    Returns:
        Metric → value, and the median of the orientation errors.
    """
    num_birds = len(next(iter(errors.values())))
    row = BirdSums.of(range(num_birds), errors, where).values()
    if "orientation_deg" in errors:
        angles = errors["orientation_deg"] if where is None else errors["orientation_deg"][where]
        angles = angles[np.isfinite(angles)]
        row["orientation_median_deg"] = float(np.median(angles)) if angles.size else math.nan
    return {name: row[name] for name in (*COLUMNS, *COLUMNS_3D) if name in row}


_logger = logging.getLogger(__name__)

_REMEDY = "give the annotations of the same video"
_MIN_MEDIAN_IOU = 0.05
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
    if not measured.any():
        own, true = ((_some(each.track_id), _some(each.frame_index)) for each in (solution, seen))
        problem = f"shares no bird with the result: tracks {true[0]}, frames {true[1]} against {own[0]}, {own[1]}"
        raise InputError(source, problem, _REMEDY)
    _check_sizes(solution, seen, measured, (n_truth, t_truth), source)
    spatial = None
    if truth.solution is not None:
        spatial = SpatialErrors(solution, bird, truth.solution, truth.bird or bird, source)
    either = measured if spatial is None else measured | spatial.measured
    behaviour = np.full(measured.shape, "")
    if truth.behaviours is not None:
        behaviour = _behaviour_of_frames(truth.behaviours, solution, either, source)
    masks = compare_masks(solution, bird, seen, measured, (n_truth, t_truth), progress)
    overlaps = masks.iou[np.isfinite(masks.iou)]
    if overlaps.size and np.median(overlaps) < _MIN_MEDIAN_IOU:
        text = "the birds of the result hardly overlap the birds of %s (median IoU %.2f); check the video of the truth"
        _logger.warning(text, source, np.median(overlaps))
    unmatched = solution.valid & ~shared
    if spatial is not None:
        unmatched &= ~spatial.measured

    annotated = (seen.confidence[n_truth, t_truth] > 0) & measured[..., None]
    keypoints = (solution.keypoints.px, seen.keypoints_px[n_truth, t_truth], annotated)
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
        behaviours={
            str(name): {
                "birds": float((either & (behaviour == name)).any(1).sum()),
                "frames": float((measured & (behaviour == name)).sum()),
                **metrics_of(errors, behaviour == name),
            }
            for name in np.unique(behaviour[behaviour != ""])
        },
        keypoints=_metrics_of_keypoints(bird.keypoint_names, errors, keypoints, masks.true_side_px),
        flags={} if spatial is None else _flag_quality(solution, errors["mpjpe/length"]),
        wrong={} if spatial is None else _wrong_poses(solution, errors["mpjpe/length"]),
        sums=sums,
    )


def _flag_quality(solution: Solution, error: Float[np.ndarray, "N T J"]) -> dict[str, float]:
    """Return `Evaluation.flags`; `error` is a share of the body length, NaN where nothing is measured."""
    found = flags(solution.flags.doubts)
    measured = np.isfinite(error).any(-1) & (found != "")
    if not measured.any():
        return {}
    wrong = np.nanmax(error[measured], axis=-1) > WRONG_SHARE
    flagged = found[measured] != OK
    return {"wrong": float(wrong.sum()), "flagged": float(flagged.sum()), "found": float((wrong & flagged).sum())}


def _wrong_poses(solution: Solution, error: Float[np.ndarray, "N T J"]) -> dict[int, dict[str, float]]:
    """Return `Evaluation.wrong`; `error` as for `_flag_quality`."""
    largest = np.where(np.isfinite(error), error, 0).max(-1)
    rows = {}
    for n in np.argsort(-largest.max(1), kind="stable").tolist():
        t = int(largest[n].argmax())
        if largest[n, t] > WRONG_SHARE:
            values = (largest[n] > WRONG_SHARE).sum(), solution.frame_index[t], largest[n, t]
            rows[int(solution.track_id[n])] = dict(zip(("count", "frame", "error"), map(float, values), strict=True))
    return rows


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


def _check_sizes(
    solution: Solution, seen: Observations, measured: np.ndarray, at: tuple[np.ndarray, np.ndarray], source: object
) -> None:
    """Raise InputError where an image of the truth has another size than the image of the result."""
    for n, t in np.argwhere(measured).tolist():
        own, true = tuple(solution.crops.image_size_px[n, t].tolist()), seen.image_size(int(at[0][n, 0]), int(at[1][t]))
        if own != true:
            problem = (
                f"has track {solution.track_id[n]}, frame {solution.frame_index[t]} in an image of "
                f"{true[0]}×{true[1]} pixels, but the result was fitted to an image of {own[0]}×{own[1]}"
            )
            raise InputError(source, problem, _REMEDY)


def _some(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:5])
    return f"[{shown}{', …' if len(numbers) > 5 else ''}]"
