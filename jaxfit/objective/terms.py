"""Terms of single frames (summed over the window) and terms of the bird as a whole.

A term is a pure function of the `PosedWindow`; its keyword arguments are its settings. Settings and weights are
traced, so a sweep over them needs one compiled program.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float

from jaxfit.model.rotation import safe_norm
from jaxfit.objective.curvature import Curvature, Rows
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.raster.silhouette import Kind, mask_loss, silhouette_gauss_newton

__all__ = [
    "bone_prior",
    "geman_mcclure",
    "keypoints",
    "mask",
    "mask_smooth_l1",
    "pose_prior",
    "shape_norm",
    "shape_prior",
    "stage_anchor",
]

Scalar = Float[Array, ""]


def geman_mcclure(error: Float[Array, "*B"], sigma: Float[Array, ""] | float) -> Float[Array, "*B"]:
    """Return the Geman-McClure error σ²e² / (σ² + e²), which is quadratic near zero and bounded by σ²."""
    squared = error**2
    return sigma**2 * squared / (sigma**2 + squared)


def _keypoints_curvature(window: PosedWindow, *, sigma_px: Scalar | float) -> Curvature:
    """Return H = Jᵀ·diag(w)·J with w = 2c·σ⁴/(σ² + e²)².

    This H gives an upper bound, because Geman-McClure is concave in e² and therefore lies below its tangent in e².
    """
    # without the barrier, XLA computes the Jacobian again for every use
    by_angles, by_place = jax.lax.optimization_barrier(window.keypoint_jacobian_px)
    error_px = window.keypoints_px - window.targets.keypoints_px
    weight = 2 * window.targets.confidence[..., None] * (sigma_px**2 / (sigma_px**2 + error_px**2)) ** 2
    weight = weight.reshape(by_angles.shape[:2])
    diagonal = [jnp.einsum("tri,tr->ti", J**2, weight) for J in (by_angles, by_place)]
    return Curvature(Partial(_keypoints_product, by_angles, by_place, weight), jnp.concatenate(diagonal, axis=1))


def _keypoints_product(
    by_angles: Float[Array, "T rows angles"],
    by_place: Float[Array, "T rows 4"],
    weight: Float[Array, "T rows"],
    d: Rows,
) -> Rows:
    moved_px = jnp.einsum("tri,ti->tr", by_angles, d[:, :-4]) + jnp.einsum("tri,ti->tr", by_place, d[:, -4:])
    return jnp.concatenate([jnp.einsum("tri,tr->ti", J, weight * moved_px) for J in (by_angles, by_place)], axis=1)


@term(positive=["sigma_px"], curvature=_keypoints_curvature)
def keypoints(window: PosedWindow, *, sigma_px: Scalar | float = 50.0) -> Scalar:
    """Compare projected and observed keypoints: E_kpt = Σ_t Σ_i c_i · (ρ(e_x) + ρ(e_y)), ρ Geman-McClure.

    The error e is in crop pixels, as is its scale σ = `sigma_px`; c is the confidence of the keypoint.

    Source: Hägerlind et al. 2024, keypoint term; x and y separately as in Badger et al. 2020.
    """
    error_px = window.keypoints_px - window.targets.keypoints_px
    robust = jnp.sum(geman_mcclure(error_px, sigma_px), axis=-1)
    return jnp.sum(window.targets.confidence * robust)


def _mask_curvature(window: PosedWindow) -> Curvature:
    """Return H = JᵀJ with J the derivative of the silhouette: the Gauss-Newton matrix of Σ ½e².

    The L1 norm has the same H. Its quadratic bound is ½ Σ e²/n with n = |e| ≤ 1, so H is smaller than the curvature of
    the bound. With the bound, the solver needs about twice as many steps.
    """
    ratio = window.raster.size_px / window.camera.size_px
    camera_px = window.camera.focal_px * ratio, window.camera.centre_px * ratio
    raster = {"blur": window.raster.blur, "backend": window.raster.backend}

    def frame(vertices_screen, weight, slope):
        skin = window.skin._replace(slope=slope)
        size = window.raster.size_px
        return silhouette_gauss_newton(vertices_screen, window.faces, weight, skin, size, camera_px, **raster)

    blocks = jax.vmap(frame)(window.vertices_screen, _mask_weight(window), window.skin.slope)
    return Curvature(Partial(_blocks_product, blocks), jnp.diagonal(blocks, axis1=-2, axis2=-1))


def _blocks_product(blocks: Float[Array, "T D D"], d: Rows) -> Rows:
    return jnp.einsum("tij,tj->ti", blocks, d)


@term(compares_masks=True, curvature=_mask_curvature)
def mask(window: PosedWindow) -> Scalar:
    """Compare silhouette and mask by the L1 norm: E_msk = Σ_t Σ_pixels |soft silhouette − mask|.

    The sum is over crop pixels, whatever the size of the silhouette.

    Source: Hägerlind et al. 2024, mask term.
    """
    return _mask(window, "l1")


@term(compares_masks=True, curvature=_mask_curvature)
def mask_smooth_l1(window: PosedWindow) -> Scalar:
    """Compare silhouette and mask by smooth-L1, as AVES does: Σ_t Σ_pixels ½e², e = soft silhouette − mask.

    Smooth-L1 is ½e² for |e| ≤ 1, and |e| ≤ 1 holds for all pixels.

    Source: Wang et al. 2021, section 4.
    """
    return _mask(window, "smooth_l1")


def _mask(window: PosedWindow, kind: Kind) -> Scalar:
    raster = {"blur": window.raster.blur, "backend": window.raster.backend}

    def frame(vertices_screen, target, weight):
        return mask_loss(vertices_screen, window.faces, target, weight, kind=kind, **raster)

    return jnp.sum(jax.vmap(frame)(window.vertices_screen, window.targets.mask, _mask_weight(window)))


def _mask_weight(window: PosedWindow) -> Float[Array, "T"]:
    """Return the area of a pixel of the silhouette in crop pixels, 0 for frames without a mask."""
    return jnp.asarray(window.targets.has_mask, jnp.float32) * (window.camera.size_px / window.raster.size_px) ** 2


def _pose_prior_curvature(window: PosedWindow) -> Curvature:
    """Return H = 2·Σ⁻¹ on the body pose of every present frame; the bound is exact, because the term is quadratic."""
    precision = window.priors.pose_whitener.T @ window.priors.pose_whitener
    present = jnp.asarray(window.present)
    diagonal = jnp.broadcast_to(jnp.diagonal(precision), (len(present), len(precision)))
    return Curvature(Partial(_pose_prior_product, precision, present), _body_rows(present, diagonal))


def _pose_prior_product(precision: Float[Array, "angles angles"], present: Bool[Array, "T"], d: Rows) -> Rows:
    return _body_rows(present, d[:, 3:-4] @ precision)


def _body_rows(present: Bool[Array, "T"], rows: Float[Array, "T angles"]) -> Rows:
    return jnp.pad(2 * jnp.where(present[:, None], rows, 0.0), ((0, 0), (3, 4)))


@term(curvature=_pose_prior_curvature)
def pose_prior(window: PosedWindow) -> Scalar:
    """Penalise improbable body poses: E_pp = Σ_t (x − μ)ᵀ Σ⁻¹ (x − μ), with x the flattened body pose.

    Source: Badger et al. 2020, pose prior.
    """
    present = window.targets.present
    offset = window.pose.body_pose.reshape(present.shape[0], -1) - window.priors.pose_mean
    distance = jnp.sum((offset @ window.priors.pose_whitener.T) ** 2, axis=-1)
    return jnp.sum(jnp.where(present, distance, 0.0))


@term
def bone_prior(window: PosedWindow) -> Scalar:
    """Penalise improbable bone lengths b: E = (b − μ_b)ᵀ Σ_b⁻¹ (b − μ_b).

    Source: Badger et al. 2020, bone-length prior.
    """
    return jnp.sum((window.priors.bone_whitener @ (window.pose.bone_length - window.priors.bone_mean)) ** 2)


@term
def shape_prior(window: PosedWindow) -> Scalar:
    """Penalise improbable shapes by the squared Mahalanobis distance of the shape coefficients: E = Σ (β / sd)²."""
    return jnp.sum((window.pose.betas / window.priors.shape_sd) ** 2)


@term
def shape_norm(window: PosedWindow) -> Scalar:
    """Penalise the norm of the shape coefficients, E = ‖β‖₂.

    The norm is not squared, so a bird keeps the mean shape unless the other terms gain more than the norm costs.

    Source: Wang et al. 2021, shape regularisation.
    """
    return safe_norm(jnp.asarray(window.pose.betas))


@term
def stage_anchor(window: PosedWindow) -> Scalar:
    """Keep body pose θ_p and bone lengths b close to their values at the start of the stage.

    E = Σ_t ‖θ_p − θ_p,anchor‖₁ + ‖b − b_anchor‖₁, with `window.anchor` the pose at the start of the stage.

    Source: Wang et al. 2021, section 4 (third stage).
    """
    moved = jnp.sum(jnp.abs(window.pose.body_pose - window.anchor.body_pose), axis=(-2, -1))
    stretched = jnp.sum(jnp.abs(window.pose.bone_length - window.anchor.bone_length))
    return jnp.sum(jnp.where(window.targets.present, moved, 0.0)) + stretched
