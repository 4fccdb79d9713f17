"""The terms that tie the frames of a window together. Pairs and triples with a missing frame count nothing."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxfit.model.rotation import safe_norm
from jaxfit.objective.registry import term
from jaxfit.objective.scene import Scene
from jaxfit.objective.terms import Scalar

__all__ = ["acceleration", "complete_runs", "velocity"]


@term
def velocity(scene: Scene, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0) -> Scalar:
    """E_vel = Σ_k β_k Σ_i ‖θ_k,i+1 − θ_k,i‖₂ over k = global orientation, body pose.

    Source: Hägerlind et al. 2024, velocity term; norms not squared.
    """
    return _differences(scene, 1, beta_global, beta_pose)


@term
def acceleration(scene: Scene, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0) -> Scalar:
    """E_acc = Σ_k β_k Σ_i ‖θ′_k,i+1 − θ′_k,i‖₂ with θ′ the frame-to-frame difference.

    Source: Hägerlind et al. 2024, acceleration term; norms not squared.
    """
    return _differences(scene, 2, beta_global, beta_pose)


def _differences(scene: Scene, order: int, beta_global: Scalar | float, beta_pose: Scalar | float) -> Scalar:
    frames = scene.pose.global_orient.shape[0]
    if frames <= order:
        return jnp.zeros(())
    complete = complete_runs(scene.evidence.present, order)
    orient = safe_norm(jnp.diff(scene.pose.global_orient, order, axis=0))
    body = safe_norm(jnp.diff(scene.pose.body_pose.reshape(frames, -1), order, axis=0))
    return jnp.sum(jnp.where(complete, beta_global * orient + beta_pose * body, 0.0))


def complete_runs(present: Bool[Array | np.ndarray, "T"], order: int) -> Bool[Array | np.ndarray, "runs"]:
    """Whether frames i, i + 1, …, i + order are all there."""
    frames = present.shape[0]
    complete = present[: frames - order]
    for shift in range(1, order + 1):
        complete = complete & present[shift : frames - order + shift]
    return complete
