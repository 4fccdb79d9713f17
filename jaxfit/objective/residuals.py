"""Residuals: one definition gives the value, the gradient and the curvature of a term.

A term E = Σ w·ρ(‖r‖²) sums over groups of residuals r. ρ is a robust kernel: concave, increasing, with ρ(0) = 0. Then
½ Jᵀ·diag(2w·ρ′)·J bounds E from above, with J the derivatives of the residuals, which JAX computes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int8

from jaxfit.objective.curvature import Curvature, Rows, frame_rows, shared_columns, sum_of_curvatures
from jaxfit.objective.posed_window import PosedWindow

Scalar = Float[Array, ""]

SHORTEST, AT_REST = 1e-4, 0.05
"""Lengths for the curvature of a norm, which is infinite at zero: residuals shorter than `SHORTEST` count as
`SHORTEST`, and residuals of exactly zero count as `AT_REST`. `AT_REST` is a typical change of a pose from frame to
frame in radians; with a smaller value, a fit that starts with the same pose in all frames would hardly move."""

PROBES = 16
"""Number of random signs from which the diagonal of H is estimated."""


class RobustKernel(NamedTuple):
    """A robust kernel ρ(s) of the squared norm s of a residual."""

    value: Callable[[Float[Array, "*G"]], Float[Array, "*G"]]
    """s ↦ ρ(s), with a finite derivative at s = 0."""
    slope: Callable[[Float[Array, "*G"]], Float[Array, "*G"]]
    """s ↦ ρ′(s), or a finite number where ρ′ is infinite."""


def _safe_sqrt(s: Float[Array, "*G"]) -> Float[Array, "*G"]:
    return jnp.where(s == 0, 0.0, jnp.sqrt(jnp.where(s == 0, 1.0, s)))


def _norm_slope(s: Float[Array, "*G"]) -> Float[Array, "*G"]:
    norm = _safe_sqrt(s)
    return 0.5 / jnp.where(norm == 0, AT_REST, jnp.maximum(norm, SHORTEST))


SQUARE = RobustKernel(lambda s: s, jnp.ones_like)
"""ρ = ‖r‖²."""
NORM = RobustKernel(_safe_sqrt, _norm_slope)
"""ρ = ‖r‖; for groups of one residual, this is |r|."""


def geman_mcclure(sigma: Scalar | float) -> RobustKernel:
    """Return Geman-McClure's kernel ρ = σ²s/(σ² + s), which is quadratic near zero and bounded by σ²."""
    return RobustKernel(lambda s: sigma**2 * s / (sigma**2 + s), lambda s: (sigma**2 / (sigma**2 + s)) ** 2)


def huber(delta: Scalar | float) -> RobustKernel:
    """Return Huber's kernel: ρ = s/2 for ‖r‖ ≤ δ, else δ(‖r‖ − δ/2)."""

    def value(s):
        clipped = jnp.minimum(_safe_sqrt(s), delta)
        return clipped * (_safe_sqrt(s) - clipped / 2)

    return RobustKernel(value, lambda s: 0.5 * delta / jnp.maximum(_safe_sqrt(s), delta))


def student_t(dof: Scalar | float, size: int) -> RobustKernel:
    """Return Student's t: ρ = (ν + n)/2 · log(1 + s/ν), the negative log-density of n residuals of scale 1, in nats."""
    half = (dof + size) / 2
    return RobustKernel(lambda s: half * jnp.log1p(s / dof), lambda s: half / (dof + s))


class Residuals(NamedTuple):
    """A sum E = Σ w·ρ(‖r‖²) over groups of residuals."""

    values: Float[Array | np.ndarray, "*G n"]
    """The residuals r, in groups along the last axis."""
    weight: Any = 1.0
    """Weight w ≥ 0 of each group, an array that broadcasts to the leading axes of `values`. It must not depend on the
    pose."""
    kernel: RobustKernel = SQUARE
    jacobian: Callable[[], Sequence[Float[Array, "T R part"]]] | None = None
    """Optional: returns the derivatives of the R residuals of each frame with respect to the row of the frame
    (`frame_rows`), in blocks of columns. Only for speed, where a formula is faster than automatic differentiation. The
    first axis of `values` is then that of the frames, and no residual depends on other frames."""
    chain: bool = False
    """Whether every residual depends on at most three consecutive frames, and in each on one joint alone, or on the
    translation alone. Only for speed: the solver then knows how consecutive frames are coupled."""


def residual_sum(residuals: Residuals | Sequence[Residuals]) -> Scalar:
    """Return Σ w·ρ(‖r‖²)."""
    parts = [each.weight * each.kernel.value(_squared(each)) for each in as_list(residuals)]
    return sum((jnp.sum(part) for part in parts), start=jnp.zeros(()))


def residual_curvature(
    window: PosedWindow,
    terms: Sequence[Callable[[PosedWindow], Residuals | Sequence[Residuals]]],
    second_order: bool = False,
) -> Curvature:
    """Return H = Jᵀ·diag(2w·ρ′)·J of the residuals of a window.

    This H bounds the curvature of a robust kernel from above. With `second_order`, H is the curvature of the kernel
    itself, as an average over the directions of a group of n residuals: Jᵀ·diag(2w·max(ρ′ + 2sρ″/n, 0))·J with
    s = ‖r‖². For Student's t, the mean of this H over the density is the Fisher information. The bound is larger by
    the factor (ν + n + 2)/(ν + n), so standard deviations from the bound would be too small.

    If the residuals have neither `jacobian` nor `chain`, the product with H is exact and its diagonal is an estimate:
    the mean of (Jᵀ·√(2w·ρ′)·u)² over `PROBES` vectors u of random signs, which are always the same.

    Args:
        window: one bird in one window.
        terms: each returns residuals of a window.
        second_order: whether H includes the second derivative ρ″ of the kernels.

    Source: Holland and Welsch 1977, Robust regression using iteratively reweighted least-squares; Hutchinson 1990, A
    stochastic estimator of the trace of the influence matrix (random signs).
    """

    # E = Σ w·ρ(s), s = ‖r‖²: dE = Σ 2w·ρ′·r·dr. Without the derivatives of J and of ρ′, the second derivative is
    # Jᵀ·diag(2w·ρ′)·J. ρ is concave in s, so the square with the slope ρ′ at the current s lies above ρ everywhere.
    def factor_of(each: Residuals) -> Float[Array, "..."]:
        slope = _mean_slope(each) if second_order else each.kernel.slope(_squared(each))
        factor = jax.lax.stop_gradient(2 * each.weight * slope)
        return jnp.broadcast_to(factor[..., None], each.values.shape)

    parts = [(function, i, part) for function in terms for i, part in enumerate(as_list(function(window)))]
    curvatures = [_from_jacobian(part, factor_of(part)) for *_, part in parts if part.jacobian is not None]
    for chain in (False, True):
        own = [(function, i, part) for function, i, part in parts if part.jacobian is None and part.chain == chain]

        def values_at(d: Rows, own: Any = own) -> list[Float[Array, "..."]]:
            moved = window.moved(d)
            return [jnp.asarray(as_list(function(moved))[i].values) for function, i, _ in own]

        if own:
            curvatures.append(_from_jax(window, values_at, [factor_of(part) for *_, part in own], chain))
    return sum_of_curvatures(curvatures)


def _from_jacobian(residuals: Residuals, factor: Float[Array, "..."]) -> Curvature:
    """Return the curvature of residuals of single frames from their Jacobian."""
    assert residuals.jacobian is not None
    # without the barrier, XLA computes the Jacobian again for every use
    blocks = jax.lax.optimization_barrier(tuple(residuals.jacobian()))
    factor = factor.reshape(blocks[0].shape[:2])
    ends = np.cumsum([block.shape[-1] for block in blocks])

    def product(d: Rows) -> Rows:
        parts = zip(blocks, jnp.split(d, ends[:-1], axis=1), strict=True)
        change = factor * sum((jnp.einsum("tri,ti->tr", J, part) for J, part in parts), start=jnp.zeros(()))
        return jnp.concatenate([jnp.einsum("tri,tr->ti", J, change) for J in blocks], axis=1)

    diagonal = [jnp.einsum("tri,tr->ti", J**2, factor) for J in blocks]
    return Curvature(product, jnp.concatenate(diagonal, axis=1))


def _from_jax(
    window: PosedWindow, values_at: Callable[[Rows], list], factors: list[Float[Array, "..."]], chain: bool
) -> Curvature:
    """Return the curvature of residuals, as functions of a change of the pose."""
    zero = jnp.zeros_like(frame_rows(window.pose, window.shared))
    _, forward = jax.linearize(values_at, zero)
    backward = jax.linear_transpose(forward, zero)

    def product(d: Rows) -> Rows:
        return backward([factor * change for factor, change in zip(factors, forward(d), strict=True)])[0]

    if chain:
        return Curvature(product, *_bands(product, *zero.shape))

    # E[(Jᵀ·√D·u)ᵢ²] = Σ_r J_ri²·D_r = H_ii, because random signs of different residuals have the mean product 0
    def probe(signs: Sequence[Int8[Array | np.ndarray, "..."]]) -> Rows:
        return backward([jnp.sqrt(factor) * sign for factor, sign in zip(factors, signs, strict=True)])[0] ** 2

    random = np.random.default_rng(0)  # not of JAX, whose generator would be compiled into the program
    signs = [random.choice(np.array([-1, 1], np.int8), (PROBES, *factor.shape)) for factor in factors]
    diagonal = jax.vmap(probe)(signs).mean(axis=0)
    # the gradient of a shared parameter is divided between the rows, so its square is too small
    rows = jnp.where(shared_columns(window.pose, window.shared), len(zero), 1)
    return Curvature(product, rows * diagonal)


def _bands(product: Callable[[Rows], Rows], frames: int, columns: int) -> tuple[Rows, Float[Array, "2 T D"]]:
    """Return the diagonal and the `Curvature.bands` of residuals that are a `chain`, from 15 products.

    Each product is with ones in one of the three components of every joint, in every fifth frame. H couples these
    neither with each other nor with the same frame or joint, so the products hold single entries of H.
    """
    which = np.arange(5)[:, None, None, None], np.arange(3)[:, None, None]
    combs = (np.arange(frames)[:, None] % 5 == which[0]) & (np.arange(columns) % 3 == which[1])
    products = jax.vmap(product)(jnp.asarray(combs.reshape(15, frames, columns), jnp.float32))
    products = jnp.pad(products.reshape(5, 3, frames, columns), [(0, 0), (0, 0), (0, 2), (0, 0)])
    frame, column = np.arange(frames)[:, None], np.arange(columns)
    # `frame_rows` has the three components of every joint, and of the translation, beside each other
    diagonal, *bands = (products[frame % 5, column % 3, frame + ahead, column] for ahead in range(3))
    return diagonal, jnp.stack(bands)


def as_list(residuals: Residuals | Sequence[Residuals]) -> list[Residuals]:
    """Return residuals as a list."""
    return [residuals] if isinstance(residuals, Residuals) else list(residuals)


def _mean_slope(residuals: Residuals) -> Float[Array, "*G"]:
    """Return max(ρ′ + 2sρ″/n, 0) of each group of n residuals."""
    squared = _squared(residuals)
    # d²ρ(‖r‖²)/dr² = 2ρ′·I + 4ρ″·r·rᵀ; the mean of rrᵀ over directions is s/n·I. Negative curvature counts as 0.
    slope, bend = jax.jvp(residuals.kernel.slope, (squared,), (jnp.ones_like(squared),))
    return jnp.maximum(slope + 2 * squared * bend / residuals.values.shape[-1], 0)


def _squared(residuals: Residuals) -> Float[Array, "*G"]:
    return jnp.sum(residuals.values**2, axis=-1)
