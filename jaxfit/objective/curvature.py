"""The curvature of the objective: the matrix H that a Gauss-Newton step needs beside the gradient.

At the current pose, the quadratic E + g·d + ½ d·H·d is an upper bound of a term E for a change d of the pose, where g
is the gradient of E. The bound is exact if the residuals are linear in the pose, and holds to first order otherwise.
Robust errors and unsquared norms become weighted squares: this is iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.model.kinematics import Pose

SMALLEST_PIVOT = 1e-5
"""Of the diagonal; far above the rounding of float32 (6e-8), far below the pivots of real windows."""
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


NO_BANDS = np.zeros((2, 1, 1), np.float32)


class Curvature(NamedTuple):
    """A positive semi-definite H on rows of frames."""

    product: Callable[[Rows], Rows]
    """d ↦ H·d, for a d whose rows agree in the shared parameters. Only the mean over the rows of the result counts for
    these parameters."""
    diagonal: Rows
    """Diagonal of H. For a shared parameter, only the mean over the rows counts."""
    bands: Float[Array, "2 T D"] | Float[np.ndarray, "2 1 1"] = NO_BANDS
    """Entries of H between a parameter of a frame and the same parameter one frame later and two frames later; 0 for
    the last frames. Only the solver's preconditioner uses them, so they may be left out."""


def block_curvature(blocks: FrameBlocks) -> Curvature:
    """Return the curvature of blocks."""
    return Curvature(lambda d: jnp.einsum("tij,tj->ti", blocks, d), jnp.diagonal(blocks, axis1=-2, axis2=-1))


def sum_of_curvatures(curvatures: Sequence[Curvature]) -> Curvature:
    """Return Σ H of some curvatures."""

    def product(d: Rows) -> Rows:
        return sum((H.product(d) for H in curvatures), start=jnp.zeros_like(d))

    # curvatures add: H = Σ λ·H_term, and so do products, diagonals and bands
    diagonal = sum((H.diagonal for H in curvatures), start=jnp.zeros(()))
    return Curvature(product, diagonal, sum((H.bands for H in curvatures), start=NO_BANDS))


def pentadiagonal_solver(diagonal: Rows, bands: Float[Array, "2 T D"]) -> Callable[[Rows], Rows]:
    """Return v ↦ P⁻¹·v for the part P of H between equal parameters of frames at most two apart.

    P is a pentadiagonal matrix for every parameter, factored as L·D·Lᵀ. Where rounding makes a pivot vanish, the pivot
    is a small share of the diagonal, so that P is always positive definite.

    Args:
        diagonal: diagonal of P, positive.
        bands: entries of P one and two frames apart, as `Curvature.bands`.
    """
    to_1, to_2 = (jnp.concatenate([jnp.zeros_like(b[:k]), b[:-k]]) for k, b in ((1, bands[0]), (2, bands[1])))
    one = jnp.ones_like(diagonal[0])

    def factor(before: Any, row: Any) -> Any:
        pivot_1, pivot_2, lower_1 = before  # of the frame before, of two frames before
        a, b, c = row  # the diagonal, and the entries one and two frames before
        second = c / pivot_2
        first = (b - second * pivot_2 * lower_1) / pivot_1
        pivot = jnp.maximum(a - first**2 * pivot_1 - second**2 * pivot_2, SMALLEST_PIVOT * a)
        return (pivot, pivot_1, first), (pivot, first, second)

    _, (pivots, lower_1, lower_2) = jax.lax.scan(factor, (one, one, 0 * one), (diagonal, to_1, to_2))

    def substitute(before: Any, row: Any) -> Any:
        (x_1, x_2), (v, b, c) = before, row
        x = v - b * x_1 - c * x_2
        return (x, x_1), x

    upper_1, upper_2 = (jnp.concatenate([b[k:], jnp.zeros_like(b[:k])]) for k, b in ((1, lower_1), (2, lower_2)))

    def solve(rows: Rows) -> Rows:
        start = jnp.zeros_like(rows[0]), jnp.zeros_like(rows[0])
        _, y = jax.lax.scan(substitute, start, (rows, lower_1, lower_2))
        return jax.lax.scan(substitute, start, (y / pivots, upper_1, upper_2), reverse=True)[1]

    return solve


def frame_rows(pose: Pose, shared: Sequence[str] = ()) -> Rows | Float[np.ndarray, "T D"]:
    """Return the pose of a window as one row per frame, with the parameters `shared`.

    `shared` holds names of `SHARED_PARAMETERS`, in that order. A parameter that all frames share is repeated in every
    row. Rows of NumPy arrays are NumPy arrays: JAX would compile a program for every operation.
    """
    xp: Any = np if isinstance(pose.transl, np.ndarray) else jnp
    frames = pose.global_orient.shape[0]
    scale = xp.broadcast_to(pose.scale, (frames,))
    columns = [pose.global_orient, pose.body_pose.reshape(frames, -1), pose.transl, scale[:, None]]
    for name in shared:
        values = xp.asarray(getattr(pose, name))
        columns.append(xp.broadcast_to(values, (frames, values.shape[-1])))
    return xp.concatenate(columns, axis=1)


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
