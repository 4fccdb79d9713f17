"""The curvature of a term: the matrix H that a Gauss-Newton step needs beside the gradient.

At the current pose, the quadratic E + g·d + ½ d·H·d is an upper bound of a term E for a change d of the pose, where g
is the gradient of E. The bound is exact if the residuals are linear in the pose, and holds to first order otherwise.
Robust errors and unsquared norms become weighted squares: this is iteratively reweighted least squares.
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
"""A change of the pose, or a gradient, one row per frame: global orientation (3), body pose (3(J−1)), translation (3),
scale (1)."""


class Curvature(NamedTuple):
    """A positive semi-definite H on rows of frames. It is a pytree, so that a solver can keep it between steps."""

    product: Partial
    """d ↦ H·d: a `jax.tree_util.Partial` of a function at the top level of a module, and the arrays that it needs."""
    diagonal: Rows
    """Diagonal of H."""


def weighted_curvature(weights: Sequence[Float[Array, ""]], curvatures: Sequence[Curvature]) -> Curvature:
    """Return Σ λ · H of some curvatures."""
    diagonal = sum((w * H.diagonal for w, H in zip(weights, curvatures, strict=True)), start=jnp.zeros(()))
    return Curvature(Partial(_weighted_product, list(weights), [H.product for H in curvatures]), diagonal)


def _weighted_product(weights: list[Float[Array, ""]], products: list[Partial], d: Rows) -> Rows:
    return sum((w * product(d) for w, product in zip(weights, products, strict=True)), start=jnp.zeros_like(d))


def frame_rows(pose: Pose) -> Rows:
    """Return the pose of a window as one row per frame, without bone lengths and shape.

    A scale that all frames share is repeated in every row.
    """
    frames = pose.global_orient.shape[0]
    scale = jnp.broadcast_to(pose.scale, (frames,))
    return jnp.concatenate(
        [pose.global_orient, pose.body_pose.reshape(frames, -1), pose.transl, scale[:, None]], axis=1
    )
