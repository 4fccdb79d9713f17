"""Observations of the birds of a result, matched by track id and frame number."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution

__all__ = ["Detected"]


class Detected:
    """Access to the observations by positions of tracks and frames in a result.

    Args:
        solution: the result.
        observations: the observations of the fit, or others of the same video; None for no observations.

    Raises:
        InputError: the observations have other keypoints than the result.
    """

    def __init__(self, solution: Solution, observations: Observations | None):
        self._count = len(solution.keypoint_names)
        self._rows, self._columns = {}, {}
        if observations is None:
            return
        self._observations = check_keypoints(observations, solution.keypoint_names, "observations")
        rows = {int(track): n for n, track in enumerate(observations.track_id)}
        columns = {int(frame): t for t, frame in enumerate(observations.frame_index)}
        self._rows = {n: rows[int(track)] for n, track in enumerate(solution.track_id) if int(track) in rows}
        self._columns = {t: columns[int(f)] for t, f in enumerate(solution.frame_index) if int(f) in columns}

    def keypoints(self, n: int, t: int) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
        """Return keypoints (image pixels) and confidence at positions of the result; 0 without an observation."""
        if n not in self._rows or t not in self._columns:
            return np.zeros((self._count, 2), np.float32), np.zeros(self._count, np.float32)
        at = self._rows[n], self._columns[t]
        return self._observations.keypoints_px[at], self._observations.confidence[at]

    def mask(self, n: int, t: int) -> Bool[np.ndarray, "H W"] | None:
        """Return the mask of the bird, or None without a mask."""
        if n not in self._rows or t not in self._columns:
            return None
        return self._observations.mask(self._rows[n], self._columns[t])
