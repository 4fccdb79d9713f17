"""The objective: the weighted sum of its terms."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfit.objective import temporal, terms
from jaxfit.objective.scene import Scene

__all__ = ["TERMS", "compares_masks", "evaluate_terms", "term_settings", "weighted_sum"]

Term = Callable[..., Float[Array, ""]]

TERMS: Mapping[str, Term] = {
    "keypoints": terms.keypoints,
    "mask": terms.mask,
    "mask_smooth_l1": terms.mask_smooth_l1,
    "pose_prior": terms.pose_prior,
    "bone_prior": terms.bone_prior,
    "shape_prior": terms.shape_prior,
    "shape_norm": terms.shape_norm,
    "start_pull": terms.start_pull,
    "velocity": temporal.velocity,
    "acceleration": temporal.acceleration,
}
"""Every term by name. To add one: a pure function of the scene, marked where it compares masks, and a line here."""

Settings = Mapping[str, Mapping[str, Float[Array, ""] | float]]


def term_settings(name: str) -> dict[str, float]:
    """A term's own settings and their defaults: its keyword arguments."""
    parameters = inspect.signature(TERMS[name]).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


def compares_masks(name: str) -> bool:
    """Whether a term looks at the silhouette, as `terms.compares_masks` marks it."""
    return getattr(TERMS[name], "compares_masks", False)


def evaluate_terms(scene: Scene, settings: Settings) -> dict[str, Float[Array, ""]]:
    """Each term of `settings` by itself, unweighted.

    Args:
        scene: one bird in one window.
        settings: for each active term, `weight` and the term's own settings; all may be traced.
    """
    return {
        name: TERMS[name](scene, **{k: v for k, v in values.items() if k != "weight"})
        for name, values in settings.items()
    }


def weighted_sum(scene: Scene, settings: Settings) -> Float[Array, ""]:
    """E = Σ λ · E_term over the active terms.

    Source: Hägerlind et al. 2024, total objective.
    """
    values = evaluate_terms(scene, settings)
    return sum((settings[name]["weight"] * value for name, value in values.items()), start=jnp.zeros(()))
