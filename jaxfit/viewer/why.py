"""What speaks for and against one pose, each beside the usual value of the result."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import DOUBTS, expected_error, flags, keypoint_distances
from jaxfit.data.mask_comparison import compare_masks
from jaxfit.data.observations import Observations, mean_confidence
from jaxfit.data.solution import Solution
from jaxfit.data.tracks import positions_in
from jaxfit.foundation.progress import silent
from jaxfit.model.bird import Bird

USUAL_POSES = 100
"""Poses, evenly spaced over the result, whose median is the usual IoU and the usual distance of one keypoint."""


class Measures(NamedTuple):
    """How single poses compare with their detections; NaN where nothing is known."""

    distance: Float[np.ndarray, "M K"]
    """Distance of each keypoint of the pose from its detection, as a share of the longer side of the box."""
    confidence: Float[np.ndarray, "M K"]
    """0 for a keypoint that is not detected."""
    side_px: Float[np.ndarray, "M"]
    """Longer side of the box."""
    iou: Float[np.ndarray, "M"]
    """IoU of mesh and mask."""


class Why:
    """The reasons for the flags of a result.

    Args:
        solution, bird: the result, as its film shows it.
        observations: what was detected; None says nothing about detections.
        lens: the lens of the film; with a lens, meshes are not compared with masks.
    """

    def __init__(self, solution: Solution, bird: Bird, observations: Observations | None, lens: Camera | None):
        self._solution, self._bird, self._seen, self._lens = solution, bird, observations, lens
        self._error = expected_error(solution, bird)
        if observations is not None:
            # positions in the observations; the last one, which is not known, stands for −1
            rows, columns = (
                positions_in(getattr(solution, name), getattr(observations, name))
                for name in ("track_id", "frame_index")
            )
            self._at = rows[:, None], columns
            self._known = (rows >= 0)[:, None] & (columns >= 0) & observations.present[self._at]

    @cached_property
    def compared(self) -> dict[str, Float[np.ndarray, "N T"]]:
        """Distance of the keypoints from the detections (`residual`) and their confidence, by which poses are flagged.

        NaN where a pose has no detection. Needs observations.
        """
        seen = self._seen
        assert seen is not None
        values = {"residual": keypoint_distances(seen, self._solution), "confidence": mean_confidence(seen.confidence)}
        return {name: np.where(self._known & self._solution.valid, of[self._at], np.nan) for name, of in values.items()}

    def entries(self, n: int, t: int) -> dict[str, Any]:
        """Return the flag of a pose, its doubts, measures, and the detected keypoints from the worst to the best.

        Args:
            n, t: positions of the track and the frame.
        """
        s = self._solution
        if not s.valid[n, t]:
            return {"flag": "no pose", "doubts": [], "measures": [], "keypoints": []}
        doubts = max(int(s.flags.doubts[n, t]), 0)
        measures, keypoints = [], []

        def add(title: str, here: float, usual: float, form: str, doubt: int) -> None:
            if np.isfinite(here) and np.isfinite(usual):
                texts = {"here": form.format(here), "usual": form.format(usual)}
                measures.append({"title": title, **texts, "bad": bool(doubts >> doubt & 1)})

        if self._seen is not None:
            here, usual = self._measure(np.array([[n, t]])), self._usual
            residual, confidence = self.compared["residual"], self.compared["confidence"]
            add("Keypoints off, of the box", residual[n, t], _median(residual), "{:.1%}", 0)
            add("Outline agreement (IoU)", here.iou[0], _median(usual.iou), "{:.0%}", 1)
            add("Confidence", confidence[n, t], _median(confidence), "{:.2f}", 4)
            distance_px = here.distance[0] * here.side_px[0]
            found = np.flatnonzero(here.confidence[0] > 0)
            for k in found[np.argsort(-(distance_px * here.confidence[0])[found], kind="stable")].tolist():
                usual_px = _median(usual.distance[:, k]) * here.side_px[0]
                values = {"px": distance_px[k], "usual_px": usual_px, "confidence": here.confidence[0, k]}
                numbers = {
                    name: round(float(value), 2) if np.isfinite(value) else None for name, value in values.items()
                }
                keypoints.append({"k": k, "name": s.keypoint_names[k].replace("_", " "), **numbers})
        add("Error bars, of the length", self._error[n, t], _median(self._error[s.valid]), "{:.1%}", 3)
        second = s.flags.ambiguity_deg
        if second[n, t] > 0:
            add("Second pose, turned by", second[n, t], _median(second[s.valid]), "{:.0f}°", 2)
        return {
            "flag": str(flags(s.flags.doubts[n, t])) or "no flag",
            "doubts": [doubt.text for i, doubt in enumerate(DOUBTS) if doubts >> i & 1],
            "measures": measures,
            "keypoints": keypoints,
        }

    @cached_property
    def _usual(self) -> Measures:
        cells = np.argwhere(self._solution.valid)
        return self._measure(cells[np.unique(np.linspace(0, len(cells) - 1, USUAL_POSES).astype(int))])

    def _measure(self, cells: np.ndarray) -> Measures:
        """Return the measures of M poses, given as positions (M, 2)."""
        s, seen = self._solution, self._seen
        assert seen is not None
        order = [seen.keypoint_names.index(name) for name in s.keypoint_names]
        n, t = cells.T
        row, column, known = self._at[0][n, 0], self._at[1][t], self._known[n, t]
        confidence = np.where(known[:, None], seen.confidence[row, column][:, order], 0).astype(np.float64)
        offset = seen.keypoints_px[row, column][:, order] - s.keypoints.px[n, t]
        side = np.where(known, seen.box_px[row, column, 2:].max(-1), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(confidence > 0, np.linalg.norm(offset, axis=-1) / side[:, None], np.nan)
        iou = np.full(len(cells), np.nan)
        has_mask = known & [cell in seen.masks for cell in zip(row.tolist(), column.tolist(), strict=True)]
        if self._lens is None and has_mask.any():
            measured = np.zeros(s.valid.shape, bool)
            measured[n[has_mask], t[has_mask]] = True
            iou = compare_masks(s, self._bird, seen, measured, self._at, silent).iou[n, t]
        return Measures(distance, confidence, side, iou)


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
