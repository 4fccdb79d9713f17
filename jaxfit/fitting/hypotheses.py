"""Hypotheses: several initial poses of one problem, the best of them, and a second pose that is almost as good.

From above, a bird that faces the camera and a bird that faces away can explain the same keypoints. So a search may
start a fit from H poses, and the fit keeps the pose with the lowest objective. A second pose is almost as good, and is
reported as `Solution.flags.ambiguity_deg`, if

- it is another pose: its orientation differs from that of the best pose by more than `MIN_ANGLE_DEG` in the median
  frame of the window;
- it is not much less likely: the objective, a negative log-likelihood, is higher by less than log `LIKELIHOOD_RATIO`.

Between two stages, equal problems of several configs are one row, so that they are computed once until a stage gives
them different hyperparameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxfit.fitting.problem import Hyperparameters
from jaxfit.model.kinematics import Pose

LIKELIHOOD_RATIO = 20.0
"""A second pose is reported if the best pose is less than this many times as likely."""
MIN_ANGLE_DEG = 45.0
"""Hypotheses are one pose where their orientations differ by a smaller angle, and everywhere if the median does."""


class Hypotheses(NamedTuple):
    """R distinct problems with H hypotheses each, between two stages; R·H poses, as NumPy arrays."""

    pose: Pose
    solver: Any
    """The solver's state after the previous stage; None if the next stage does not continue its moments."""
    failure: np.ndarray
    """(R·H,) text as in `FittedWindow`."""
    ambiguity_deg: Float[np.ndarray, "RH T"]
    """As in `FittedWindow`; 0 before hypotheses are compared."""
    row: Int[np.ndarray, "B"]
    """Row of each problem of the batch."""
    count: int
    """Number of hypotheses H of each row."""

    def rows(self, at: np.ndarray, **changes: Any) -> Hypotheses:
        """Return some of the R·H poses, with other values for `row` and `count` in `changes`."""
        kept = self.pose, self.solver, self.failure, self.ambiguity_deg
        pose, solver, failure, ambiguity_deg = jax.tree.map(lambda x: x[at], kept)
        changes = {"row": self.row, "count": self.count} | changes
        return Hypotheses(pose, solver, failure, ambiguity_deg, **changes)


def split_rows(
    rows: Hypotheses, config: Int[np.ndarray, "B"], hyperparameters: Sequence[Hyperparameters]
) -> tuple[Hypotheses, Int[np.ndarray, "R"]]:
    """Split rows whose problems have different hyperparameters in the next stage.

    Two problems share a row of the next stage if they shared a row before and have equal hyperparameters.

    Args:
        rows: the rows of the previous stage.
        config: position of the config of each problem.
        hyperparameters: of each config, in the next stage.

    Returns:
        The rows of the next stage, and the first problem of each row.
    """
    content = [b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(values)) for values in hyperparameters]
    new_rows: dict[tuple[int, bytes], int] = {}
    pairs = zip(rows.row.tolist(), config.tolist(), strict=True)
    row = np.array([new_rows.setdefault((old_row, content[c]), len(new_rows)) for old_row, c in pairs])
    first = np.unique(row, return_index=True)[1]
    source = (rows.row[first][:, None] * rows.count + np.arange(rows.count)).ravel()
    return rows.rows(source, row=row), first


def compare_hypotheses(
    rows: Hypotheses, loss: Mapping[str, Float[np.ndarray, "RH"]], present: Bool[Array | np.ndarray, "R T"]
) -> tuple[Hypotheses, Int[np.ndarray, "R"]]:
    """Return the rows with the ambiguity of their best hypothesis, and the position of each best hypothesis.

    A hypothesis that is not finite is never the best. Poses of frames without the bird are arbitrary and do not count.

    Args:
        rows: the rows after a stage.
        loss: weighted value of each term.
        present: the frames of each row with the bird.
    """
    total = np.sum(list(loss.values()), axis=0).reshape(-1, rows.count)
    total = np.where(np.isfinite(total), total, np.inf)
    of_row = np.argmin(total, axis=1)
    best = np.arange(len(total)) * rows.count + of_row
    if rows.count == 1:
        return rows, best
    # the angle between each hypothesis and the best one of its row, in every frame
    orient = np.asarray(rows.pose.global_orient, np.float64)
    pairs = orient.reshape(-1, 3), np.repeat(orient[best], rows.count, axis=0).reshape(-1, 3)
    rotation, of_best = (scipy.spatial.transform.Rotation.from_rotvec(rotvecs) for rotvecs in pairs)
    angle_deg = np.rad2deg((rotation.inv() * of_best).magnitude()).reshape(orient.shape[:2])
    angle_deg = np.where(np.repeat(present, rows.count, axis=0), angle_deg, np.nan)
    is_other_pose = np.nanmedian(angle_deg, axis=1).reshape(total.shape) > MIN_ANGLE_DEG
    others = np.where(is_other_pose, total, np.inf)
    second = np.argmin(others, axis=1)
    with np.errstate(invalid="ignore"):  # no finite hypothesis
        is_near = others.min(axis=1) - total.min(axis=1) < np.log(LIKELIHOOD_RATIO)
    ambiguity_deg = rows.ambiguity_deg.copy()
    of_second = angle_deg[(best - of_row + second)[is_near]]
    ambiguity_deg[best[is_near]] = np.where(of_second > MIN_ANGLE_DEG, of_second, 0)
    return rows._replace(ambiguity_deg=ambiguity_deg), best
