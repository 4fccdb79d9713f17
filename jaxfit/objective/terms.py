"""Terms of single frames: keypoints, mask, priors, stage anchor, joint limits, feet on the ground.

A term is a pure function of the `PosedWindow`; its keyword arguments are its settings. Settings and weights are
traced, so a sweep over them needs one compiled program.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfit.objective.curvature import FrameBlocks
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.residuals import NORM, Residuals, Scalar, geman_mcclure
from jaxfit.objective.temporal import complete_runs
from jaxfit.raster.silhouette import Kind, mask_loss, mask_loss_and_block


@term(positive=["sigma_px"])
def keypoints(window: PosedWindow, *, sigma_px: Scalar | float = 50.0) -> Residuals:
    """Compare projected and observed keypoints: E_kpt = Σ_t Σ_i c_i · (ρ(e_x) + ρ(e_y)), ρ Geman-McClure.

    The error e is in crop pixels, as is its scale σ = `sigma_px`; c is the confidence of the keypoint.

    Source: Hägerlind et al. 2024, keypoint term; x and y separately as in Badger et al. 2020.
    """
    # groups of one residual: x and y of a keypoint are outliers independently
    error_px = window.keypoints_px - window.targets.keypoints_px
    confidence = window.targets.confidence[..., None]
    return Residuals(
        error_px[..., None], confidence, geman_mcclure(sigma_px), jacobian=lambda: window.keypoint_jacobian_px
    )


def _mask_and_blocks(window: PosedWindow, kind: Kind) -> tuple[Scalar, FrameBlocks]:
    """Return the mask term and H = JᵀJ with J the derivative of the silhouette: the Gauss-Newton matrix of Σ ½e².

    The L1 norm has the same H. Its quadratic bound is ½ Σ e²/n with n = |e| ≤ 1, so H is smaller than the curvature of
    the bound. With the bound, the solver needs about twice as many steps.
    """
    ratio = window.raster.size_px / window.camera.size_px
    camera_px = window.camera.focal_px * ratio, window.camera.centre_px * ratio
    raster = {"kind": kind, "blur": window.raster.blur, "backend": window.raster.backend}

    def frame(vertices_screen, target, weight, transforms, generators, view):
        skin = window.skin._replace(transforms=transforms, generators=generators, view=view)
        return mask_loss_and_block(vertices_screen, window.faces, target, weight, skin, camera_px, **raster)

    skin = window.skin.transforms, window.skin.generators, window.skin.view
    values, blocks = jax.vmap(frame)(window.vertices_screen, window.mask, _mask_weight(window), *skin)
    if window.targets.views is not None:
        blocks = blocks.reshape(len(window.present), -1, *blocks.shape[1:]).sum(axis=1)
    if "betas" in window.shared:  # the last columns, of coefficients that move keypoints only
        free = len(window.pose.betas) - window.skin.shape_basis.shape[-1]
        blocks = jnp.pad(blocks, ((0, 0), (0, free), (0, free)))
    return jnp.sum(values), blocks


def _mask(window: PosedWindow, kind: Kind) -> Scalar:
    raster = {"blur": window.raster.blur, "backend": window.raster.backend}

    def frame(vertices_screen, target, weight):
        return mask_loss(vertices_screen, window.faces, target, weight, kind=kind, **raster)

    return jnp.sum(jax.vmap(frame)(window.vertices_screen, window.mask, _mask_weight(window)))


@term(compares_masks=True, with_blocks=lambda window: _mask_and_blocks(window, "l1"))
def mask(window: PosedWindow) -> Scalar:
    """Compare silhouette and mask by the L1 norm: E_msk = Σ_t Σ_pixels |soft silhouette − mask|.

    The sum is over crop pixels, whatever the size of the silhouette, without the unknown pixels of the mask.

    Source: Hägerlind et al. 2024, mask term.
    """
    return _mask(window, "l1")


@term(compares_masks=True, with_blocks=lambda window: _mask_and_blocks(window, "smooth_l1"))
def mask_smooth_l1(window: PosedWindow) -> Scalar:
    """Compare silhouette and mask by smooth-L1, as AVES does: Σ_t Σ_pixels ½e², e = soft silhouette − mask.

    Smooth-L1 is ½e² for |e| ≤ 1, and |e| ≤ 1 holds for all pixels.

    Source: Wang et al. 2021, section 4.
    """
    return _mask(window, "smooth_l1")


def _mask_weight(window: PosedWindow) -> Float[Array, "I"]:
    """Return the area of a pixel of the silhouette in crop pixels, 0 for images without a mask."""
    return jnp.asarray(window.has_mask, jnp.float32) * (window.camera.size_px / window.raster.size_px) ** 2


@term
def pose_prior(window: PosedWindow) -> Residuals:
    """Penalise improbable body poses: E_pp = Σ_t (x − μ)ᵀ Σ⁻¹ (x − μ), with x the flattened body pose.

    Source: Badger et al. 2020, pose prior.
    """
    present = window.targets.present
    # ‖W(x − μ)‖² with WᵀW = Σ⁻¹; a frame without the bird has the weight 0
    offset = window.pose.body_pose.reshape(present.shape[0], -1) - window.priors.pose_mean
    return Residuals(offset @ window.priors.pose_whitener.T, jnp.asarray(present, jnp.float32))


@term
def bone_prior(window: PosedWindow) -> Residuals:
    """Penalise improbable bone lengths b: E = (b − μ_b)ᵀ Σ_b⁻¹ (b − μ_b).

    Source: Badger et al. 2020, bone-length prior.
    """
    return Residuals(window.priors.bone_whitener @ (window.pose.bone_length - window.priors.bone_mean))


@term(positive=["sd_log"])
def size_prior(window: PosedWindow, *, sd_log: Scalar | float = 0.05) -> Residuals:
    """Penalise sizes that are improbable for the species: E = mean_t (log s_t / sd)², with s the scale.

    A fit of several views estimates the size, and the term matters only where one view sees the bird. `sd_log` is the
    relative standard deviation of lengths of adults: 5 % or less in most species of birds.

    Source: ours; a log-normal size, Huxley 1932, *Problems of Relative Growth*.
    """
    # a mean over frames: one bird has one size, however long the window is
    present = jnp.asarray(window.present, jnp.float32)
    scale = jnp.broadcast_to(jnp.maximum(jnp.asarray(window.pose.scale), 1e-3), present.shape)
    return Residuals(jnp.log(scale)[:, None] / sd_log, present / jnp.maximum(jnp.sum(present), 1.0))


@term
def shape_prior(window: PosedWindow) -> Residuals:
    """Penalise improbable shapes by the squared Mahalanobis distance of the shape coefficients: E = Σ (β / sd)²."""
    return Residuals(window.pose.betas / window.priors.shape_sd)


@term
def shape_norm(window: PosedWindow) -> Residuals:
    """Penalise the norm of the shape coefficients, E = ‖β‖₂.

    The norm is not squared, so a bird keeps the mean shape unless the other terms gain more than the norm costs.

    Source: Wang et al. 2021, shape regularisation.
    """
    return Residuals(jnp.asarray(window.pose.betas), kernel=NORM)


@term
def stage_anchor(window: PosedWindow) -> tuple[Residuals, Residuals]:
    """Keep body pose θ_p and bone lengths b close to their values at the start of the stage.

    E = Σ_t ‖θ_p − θ_p,anchor‖₁ + ‖b − b_anchor‖₁, with `window.anchor` the pose at the start of the stage.

    Source: Wang et al. 2021, section 4 (third stage).
    """
    present = jnp.asarray(window.targets.present, jnp.float32)[:, None, None]
    moved = window.pose.body_pose - window.anchor.body_pose
    stretched = window.pose.bone_length - window.anchor.bone_length
    return Residuals(moved[..., None], present, NORM), Residuals(stretched[:, None], kernel=NORM)


@term
def joint_limits(window: PosedWindow) -> Residuals:
    """Penalise angles outside the joint limits, rad².

    E = Σ_t Σ_i max(l_i − θ_i, 0)² + max(θ_i − u_i, 0)², over the components i of the body pose.

    The limits l and u come from the model: a box in axis-angles. The limits of the murre are not measured: they come
    from its designed postures, with a margin of 20°. A fit with this term and a model without limits is rejected.

    Source: Kim et al. 2025, *PyRoki*, joint limit cost.
    """
    lower, upper = window.joint_limits[..., 0], window.joint_limits[..., 1]
    angles = window.pose.body_pose
    excess = jnp.maximum(lower - angles, 0) + jnp.maximum(angles - upper, 0)  # one of the two is 0
    return Residuals(excess, jnp.asarray(window.present, jnp.float32)[:, None])


@term(positive=["sigma_units"])
def feet_on_ground(window: PosedWindow, *, sigma_units: Scalar | float = 0.5) -> Residuals:
    """Penalise slow motion of the feet: standing feet do not slide.

    E = Σ_i Σ_f ρ(‖x_f,i+1 − x_f,i‖) over frames i and feet f (left, right), with ρ Geman-McClure, in model units per
    frame.

    The term reduces short displacements, but hardly affects displacements much longer than σ, so a bird may walk or
    fly. Positions are in the frame of a static camera (`keypoints_static_cam`), so the term is wrong for footage of a
    moving camera. The term does not model the ground, because one camera and a fixed depth do not determine the
    ground, and motion towards or away from the camera changes only the scale.

    Source: ours; zero velocity of feet in contact as in Rempe et al. 2021, *HuMoR*, with a robust loss instead of
    predicted contacts.
    """
    # in the crop of the first frame, a foot at rest stays where it is although the crop follows the bird
    feet = window.keypoint_indices("left_foot", "right_foot")
    displacement = jnp.diff(window.keypoints_static_cam[:, feet], axis=0)
    complete = jnp.asarray(complete_runs(window.present, 1), jnp.float32)[:, None]
    return Residuals(displacement, complete, geman_mcclure(sigma_units))
