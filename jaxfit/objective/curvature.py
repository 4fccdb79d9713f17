"""What a Gauss-Newton step needs of a term beside its gradient: the curvature of a quadratic that bounds it.

At the present pose a term E is bounded by E + g·d + ½ d·H·d for a change d, with E's own gradient g (exactly where its
residuals are linear in the pose, else to first order). Robust errors and unsquared norms thus become weighted squares:
iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfit.model.pose import Pose

__all__ = ["Curvature", "Rows", "frame_rows"]

Rows = Float[Array, "T D"]
"""A change of pose, or a gradient, by frame: global orientation (3), body pose (3(J−1)), translation (3), scale (1)."""


class Curvature(NamedTuple):
    """A positive semi-definite H on rows of frames."""

    product: Callable[[Rows], Rows]
    """d ↦ H·d."""
    diagonal: Rows


def frame_rows(pose: Pose) -> Rows:
    """A window's pose as one row a frame, without what is the window's own; a common scale stands in every row."""
    frames = pose.global_orient.shape[0]
    scale = jnp.broadcast_to(pose.scale, (frames,))
    return jnp.concatenate(
        [pose.global_orient, pose.body_pose.reshape(frames, -1), pose.transl, scale[:, None]], axis=1
    )
