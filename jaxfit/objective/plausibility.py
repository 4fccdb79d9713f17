"""Terms of physical plausibility: joint limits, and standing feet that do not slide."""

from __future__ import annotations

import jax.numpy as jnp

from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.residuals import Residuals, Scalar, geman_mcclure
from jaxfit.objective.temporal import complete_runs

__all__ = ["feet_on_ground", "joint_limits"]


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
    feet = window.keypoint_indices("left_foot", "right_foot")
    displacement = jnp.diff(window.keypoints_static_cam[:, feet], axis=0)
    complete = jnp.asarray(complete_runs(window.present, 1), jnp.float32)[:, None]
    return Residuals(displacement, complete, geman_mcclure(sigma_units))
