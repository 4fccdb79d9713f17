"""Frames in which a second, different pose explains the keypoints almost as well."""

from __future__ import annotations

import numpy as np

from jaxfit.data.solution import Solution

__all__ = ["ambiguous_frames"]


def ambiguous_frames(solution: Solution) -> dict[int, tuple[str, ...]]:
    """Return track → a text for each range of frames with a second pose (`Solution.ambiguity_deg`)."""
    assert solution.ambiguity_deg is not None  # `Solution` replaces None
    texts = {}
    for n, track in enumerate(solution.track_id.tolist()):
        angle_deg = np.where(solution.valid[n], solution.ambiguity_deg[n], 0)
        inside = np.concatenate([[0], angle_deg > 0, [0]])
        first, after = (np.flatnonzero(np.diff(inside) == sign) for sign in (1, -1))
        ranges = [
            f"frames {solution.frame_index[a]} to {solution.frame_index[b - 1]}: a pose that is turned by "
            f"{np.median(angle_deg[a:b]):.0f}° explains the keypoints almost as well"
            for a, b in zip(first.tolist(), after.tolist(), strict=True)
        ]
        if ranges:
            texts[track] = tuple(ranges)
    return texts
