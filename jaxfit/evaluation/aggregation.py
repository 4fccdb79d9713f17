"""Aggregation of per-keypoint errors into metrics, and the metrics of one result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.evaluation.bootstrap import BirdSums, Interval
from jaxfit.evaluation.spatial import COLUMNS_3D

__all__ = ["COLUMNS", "COLUMNS_3D", "COLUMNS_KEYPOINT", "Evaluation", "metrics_of"]

COLUMNS = ("pck@0.05", "pck@0.10", "iou", "me_p", "me_v")
"""Metrics in the image."""
COLUMNS_KEYPOINT = ("pck@0.05", "pck@0.10", "me_p", "me_v")
"""Metrics of one keypoint."""


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a result. NaN where nothing is measured: no mask, no two consecutive frames."""

    overall: dict[str, float]
    """COLUMNS over all birds: PCK and IoU are means over images, me_p and me_v are RMS errors over keypoints. With
    true poses also COLUMNS_3D, which `SpatialErrors` defines."""
    tracks: dict[int, dict[str, float]]
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
    behaviours: dict[str, dict[str, float]] = field(default_factory=dict)
    """Behaviour → the metrics of `overall`, the number of `birds` that show the behaviour, and the number of
    `frames`; empty where behaviours are not known. A pair of frames belongs to the behaviour in the earlier frame, a
    triple of frames to the behaviour in the middle frame."""
    keypoints: dict[str, dict[str, float]] = field(default_factory=dict)
    """Keypoint → COLUMNS_KEYPOINT of this keypoint over all birds, and the number of frames that annotate the
    keypoint as `count`."""
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
            KeyError: an entry is missing, as in a file of an older version.
        """

        def rows(name: str) -> dict[str, dict[str, float]]:
            return {key: _null_to_nan(row) for key, row in content[name].items()}

        sums = content["sums"]
        return cls(
            overall=_null_to_nan({name: content[name] for name in (*COLUMNS, *COLUMNS_3D) if name in content}),
            tracks={int(track): row for track, row in rows("tracks").items()},
            **{name: content[name] for name in ("frames", "missing", "unmatched", "frames_3d", "points_3d")},
            intervals={
                name: Interval(*_null_to_nan(dict(enumerate(bounds))).values())
                for name, bounds in content["intervals"].items()
            },
            behaviours=rows("behaviours"),
            keypoints=rows("keypoints"),
            sums=BirdSums(
                tuple(sums["birds"]),
                {metric: tuple(values) for metric, values in sums["numerators"].items()},
                {metric: tuple(values) for metric, values in sums["counts"].items()},
            ),
        )


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


def _null_to_nan(row: Mapping[Any, float | None]) -> dict[Any, float]:
    return {name: math.nan if value is None else value for name, value in row.items()}
