"""What a bird's body can and cannot do: joints bend so far and no further, feet that stand do not slide."""

from __future__ import annotations

import jax.numpy as jnp

from jaxfit.model.rotation import safe_norm
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.temporal import complete_runs
from jaxfit.objective.terms import Scalar, geman_mcclure

__all__ = ["feet_on_ground", "joint_limits"]


@term
def joint_limits(window: PosedWindow) -> Scalar:
    """Σ_t Σ_i max(l_i − θ_i, 0)² + max(θ_i − u_i, 0)² over the components of the body pose, rad².

    The limits l and u are the model's: a box in axis-angles. The murre's are those of its designed postures with a
    margin of 20°, not measured. For a model without limits the fit is refused.

    Source: Kim et al. 2025, *PyRoki*, joint limit cost.
    """
    least, greatest = window.joint_limits[..., 0], window.joint_limits[..., 1]
    angles = window.pose.body_pose
    excess = jnp.maximum(least - angles, 0) ** 2 + jnp.maximum(angles - greatest, 0) ** 2
    return jnp.sum(jnp.where(window.present, jnp.sum(excess, axis=(-2, -1)), 0.0))


@term(positive=["sigma_units"])
def feet_on_ground(window: PosedWindow, *, sigma_units: Scalar | float = 0.5) -> Scalar:
    """Σ_i Σ_f ρ(‖x_f,i+1 − x_f,i‖) over the left and right foot f, ρ Geman-McClure, in model units a frame.

    A foot that stands does not slide: slow steps are pulled to nothing, and steps much longer than σ are let go, so
    that a bird may walk or fly. Positions are those that a camera at rest sees (`keypoints_static_cam`); for film of
    a moving camera the term is wrong. The ground itself is not modelled: one camera and a fixed depth do not tell
    where it is, and sinking towards or away from the camera is seen in the scale alone.

    Source: ours; zero velocity of feet in contact as in Rempe et al. 2021, *HuMoR*, with a robust loss in place of
    predicted contacts.
    """
    feet = window.keypoint_indices("left_foot", "right_foot")
    moved = safe_norm(jnp.diff(window.keypoints_static_cam[:, feet], axis=0))
    slid = jnp.sum(geman_mcclure(moved, sigma_units), axis=-1)
    return jnp.sum(jnp.where(complete_runs(window.present, 1), slid, 0.0))
