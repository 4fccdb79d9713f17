"""The curvature of a term: what a Gauss-Newton step needs besides the gradient.

At the present pose a term E is bounded by E + g·d + ½ d·H·d for a change d of the pose, with E's own gradient g. The
bound is exact where the residuals are linear in the pose, and of first order elsewhere. Robust errors and unsquared
norms become weighted squares: iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from jaxfit.model.pose import Pose

__all__ = ["Curvature", "Rows", "frame_rows", "weighted_curvature"]

Rows = Float[Array, "T D"]
"""A change of pose, or a gradient, by frame: global orientation (3), body pose (3(J−1)), translation (3), scale (1)."""


class Curvature(NamedTuple):
    """A positive semi-definite H on rows of frames. It is a pytree, so that a solver can keep it between steps."""

    product: Partial
    """d ↦ H·d: a `jax.tree_util.Partial` of a function at the top level of a module, and the arrays that it needs."""
    diagonal: Rows


def weighted_curvature(weights: Sequence[Float[Array, ""]], curvatures: Sequence[Curvature]) -> Curvature:
    """Return Σ λ · H of some curvatures."""
    diagonal = sum((w * H.diagonal for w, H in zip(weights, curvatures, strict=True)), start=jnp.zeros(()))
    return Curvature(Partial(_weighted_product, list(weights), [H.product for H in curvatures]), diagonal)


def _weighted_product(weights: list[Float[Array, ""]], products: list[Partial], d: Rows) -> Rows:
    return sum((w * product(d) for w, product in zip(weights, products, strict=True)), start=jnp.zeros_like(d))


def frame_rows(pose: Pose) -> Rows:
    """Return a window's pose as one row for each frame, without bone lengths and shape.

    A common scale is repeated in every row.
    """
    frames = pose.global_orient.shape[0]
    scale = jnp.broadcast_to(pose.scale, (frames,))
    return jnp.concatenate(
        [pose.global_orient, pose.body_pose.reshape(frames, -1), pose.transl, scale[:, None]], axis=1
    )
