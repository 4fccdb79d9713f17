"""What an evaluation holds, and how its figures come of samples."""

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
COLUMNS_KEYPOINT = ("pck@0.05", "pck@0.10", "me_p", "me_v")


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
    intervals: dict[str, Interval] = field(default_factory=dict)
    """95 % intervals over birds of what is in `overall`, as `BirdSums.interval` defines them; the median of the
    orientation, which is no mean, has none. NaN twice for fewer than two birds."""
    behaviours: dict[str, dict[str, float]] = field(default_factory=dict)
    """Behaviour → the same as in `overall`, the number of `birds` that show it, and of their `frames`; empty where
    behaviours are not known. A pair of frames belongs to what the bird does in the earlier one, a triple to the
    middle one."""
    keypoints: dict[str, dict[str, float]] = field(default_factory=dict)
    """Keypoint → COLUMNS_KEYPOINT of this one alone, over all birds, and in how many frames it is annotated as
    `count`."""
    sums: BirdSums = field(default_factory=lambda: BirdSums((), {}, {}))
    """What all figures over birds are made of, for `paired_ratio` of results of the same birds."""

    def to_dict(self) -> dict[str, Any]:
        """All of it in what JSON knows; the metrics over all birds stand at the top."""
        content = asdict(self)
        return content.pop("overall") | content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Evaluation:
        """What `to_dict` gave, also after JSON, which makes null of NaN and text of the tracks' ids.

        Raises:
            KeyError: something is missing, as in what an older version wrote.
        """

        def rows(name: str) -> dict[str, dict[str, float]]:
            return {key: _numbers(row) for key, row in content[name].items()}

        sums = content["sums"]
        return cls(
            overall=_numbers({name: content[name] for name in (*COLUMNS, *COLUMNS_3D) if name in content}),
            tracks={int(track): row for track, row in rows("tracks").items()},
            **{name: content[name] for name in ("frames", "missing", "unmatched", "frames_3d", "points_3d")},
            intervals={
                name: Interval(*_numbers(dict(enumerate(bounds))).values())
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
    samples: Mapping[str, Float[np.ndarray, "N T _"]], where: Bool[np.ndarray, "N T"] | None = None
) -> dict[str, float]:
    """Every metric of some samples.

    Args:
        samples: metric → what each bird, frame and point adds, as `BirdSums.of` takes it.
        where: the birds and frames to take; None for all.

    Returns:
        Metric → value over all of them, also the median of the orientation's errors.
    """
    num_birds = len(next(iter(samples.values())))
    row = BirdSums.of(range(num_birds), samples, where).values()
    if "orientation_deg" in samples:
        angles = samples["orientation_deg"] if where is None else samples["orientation_deg"][where]
        angles = angles[np.isfinite(angles)]
        row["orientation_median_deg"] = float(np.median(angles)) if angles.size else math.nan
    return {name: row[name] for name in (*COLUMNS, *COLUMNS_3D) if name in row}


def _numbers(row: Mapping[Any, float | None]) -> dict[Any, float]:
    return {name: math.nan if value is None else value for name, value in row.items()}
