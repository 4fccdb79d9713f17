"""The curvature of the objective: the matrix H that a Gauss-Newton step needs beside the gradient.

At the current pose, the quadratic E + g·d + ½ d·H·d is an upper bound of a term E for a change d of the pose, where g
is the gradient of E. The bound is exact if the residuals are linear in the pose, and holds to first order otherwise.
Robust errors and unsquared norms become weighted squares: this is iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.model.kinematics import Pose

SHARED_PARAMETERS = ("bone_length", "betas")
"""The parameters that all frames of a window share, beside a common scale."""

Rows = Float[Array, "T D"]
"""A change of the pose, or a gradient, one row per frame: global orientation (3), body pose (3(J−1)), translation (3),
scale (1), and the shared parameters that are optimised: bone lengths (J−1), shape coefficients (S).

A change of a parameter that all frames share is the mean of its rows. Its gradient is divided evenly between the rows.
"""


FrameBlocks = Float[Array, "T D D"]
"""A curvature without products of different frames: one positive semi-definite block per frame, in the columns of
`frame_rows`."""


class Curvature(NamedTuple):
    """A positive semi-definite H on rows of frames."""

    product: Callable[[Rows], Rows]
    """d ↦ H·d, for a d whose rows agree in the shared parameters. Only the mean over the rows of the result counts for
    these parameters."""
    diagonal: Rows
    """Diagonal of H. For a shared parameter, only the mean over the rows counts."""


def block_curvature(blocks: FrameBlocks) -> Curvature:
    """Return the curvature of blocks."""
    return Curvature(lambda d: jnp.einsum("tij,tj->ti", blocks, d), jnp.diagonal(blocks, axis1=-2, axis2=-1))


def sum_of_curvatures(curvatures: Sequence[Curvature]) -> Curvature:
    """Return Σ H of some curvatures."""

    def product(d: Rows) -> Rows:
        return sum((H.product(d) for H in curvatures), start=jnp.zeros_like(d))

    # curvatures add: H = Σ λ·H_term, and so do products and diagonals
    return Curvature(product, sum((H.diagonal for H in curvatures), start=jnp.zeros(())))


def frame_rows(pose: Pose, shared: Sequence[str] = ()) -> Rows:
    """Return the pose of a window as one row per frame, with the parameters `shared`.

    `shared` holds names of `SHARED_PARAMETERS`, in that order. A parameter that all frames share is repeated in every
    row.
    """
    frames = pose.global_orient.shape[0]
    scale = jnp.broadcast_to(pose.scale, (frames,))
    columns = [pose.global_orient, pose.body_pose.reshape(frames, -1), pose.transl, scale[:, None]]
    for name in shared:
        values = jnp.asarray(getattr(pose, name))
        columns.append(jnp.broadcast_to(values, (frames, values.shape[-1])))
    return jnp.concatenate(columns, axis=1)


def add_rows(pose: Pose, rows: Rows, shared: Sequence[str] = ()) -> Pose:
    """Return the pose plus a change, which has one row per frame in the layout of `frame_rows`."""
    sizes = _sizes(pose, shared)
    assert rows.shape[1] == sum(sizes), (rows.shape, sizes)
    ends = np.cumsum(sizes).tolist()  # slices: with jnp.split, compiled fits round differently
    angles, transl, scale, *others = (rows[:, end - size : end] for size, end in zip(sizes, ends, strict=True))
    return replace(
        pose,
        global_orient=pose.global_orient + angles[:, :3],
        body_pose=pose.body_pose + angles[:, 3:].reshape(pose.body_pose.shape),
        transl=pose.transl + transl,
        scale=pose.scale + (scale.mean(axis=0) if _has_common_scale(pose) else scale[:, 0]),
        **{name: getattr(pose, name) + each.mean(axis=0) for name, each in zip(shared, others, strict=True)},
    )


def shared_columns(pose: Pose, shared: Sequence[str] = ()) -> Bool[np.ndarray, "D"]:
    """Return, for each column of `frame_rows`, whether all frames share the parameter."""
    is_shared = [False, False, _has_common_scale(pose), *(True for _ in shared)]
    return np.repeat(is_shared, _sizes(pose, shared))


def _sizes(pose: Pose, shared: Sequence[str]) -> list[int]:
    """Return the numbers of columns of the angles (3J), the translation, the scale, and each parameter in `shared`."""
    return [3 + 3 * pose.body_pose.shape[-2], 3, 1, *(getattr(pose, name).shape[-1] for name in shared)]


def _has_common_scale(pose: Pose) -> bool:
    """Return whether all frames of a window have one scale."""
    return pose.scale.shape[0] < pose.global_orient.shape[0]
