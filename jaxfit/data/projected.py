"""The projected keypoints of a solution as observations."""

from __future__ import annotations

import numpy as np

from jaxfit.data.boxes import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.model.anatomy import skeleton_pairs

__all__ = ["projected_observations"]


def projected_observations(solution: Solution) -> Observations:
    """Return the projected keypoints of all valid poses, with confidence 1, and their boxes."""
    N, T = solution.valid.shape
    K = len(solution.keypoint_names)
    confidence = np.broadcast_to(solution.valid[..., None], (N, T, K)).astype(np.float32)
    points = np.where(solution.valid[..., None, None], solution.keypoints_px, 0)
    box = box_of_keypoints(points, confidence > 0)
    sizes = solution.image_size_px[solution.valid]
    return Observations(
        track_id=solution.track_id,
        frame_index=solution.frame_index,
        present=solution.valid,
        keypoints_px=points,
        confidence=confidence,
        box_px=np.where(solution.valid[..., None], np.concatenate([box[..., :2], np.maximum(box[..., 2:], 1)], -1), 0),
        image_size_px=np.tile(sizes.max(0) if len(sizes) else np.ones(2, np.int64), (T, 1)),
        file_name=np.array([f"frame {number}" for number in solution.frame_index.tolist()], str).reshape(T),
        keypoint_names=solution.keypoint_names,
        skeleton=skeleton_pairs(solution.keypoint_names),
        timestamp_s=solution.timestamp_s,
        fps=solution.fps,
    )
