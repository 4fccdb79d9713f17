"""The objective: the weighted sum of its terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.objective.curvature import Curvature
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import find_term

__all__ = ["evaluate_curvature", "evaluate_terms", "weighted_sum"]

Settings = Mapping[str, Mapping[str, Float[Array | np.ndarray, ""] | float]]


def evaluate_terms(window: PosedWindow, settings: Settings) -> dict[str, Float[Array, ""]]:
    """Return the unweighted value of each term of `settings`.

    Args:
        window: one bird in one window.
        settings: for each active term, `weight` and the settings of the term; all values may be traced.

    Raises:
        InputError: a term does not return one real number; the message names the term.
    """
    return {
        name: _scalar(name, find_term(name).function(window, **{k: v for k, v in own.items() if k != "weight"}))
        for name, own in settings.items()
    }


def weighted_sum(window: PosedWindow, settings: Settings) -> Float[Array, ""]:
    """Return the objective E = Σ λ · E_term over the active terms.

    Source: Hägerlind et al. 2024, total objective.
    """
    values = evaluate_terms(window, settings)
    return sum((jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()), start=jnp.zeros(()))


def evaluate_curvature(window: PosedWindow, settings: Settings) -> Curvature:
    """Return the curvature Σ λ · H_term of the objective; every active term must have a curvature.

    Args:
        window: one bird in one window.
        settings: as for `evaluate_terms`.
    """
    weighted = []
    for name, own in settings.items():
        find = find_term(name).curvature
        assert find is not None, name  # the check of the config has rejected terms without curvature
        weighted.append((own["weight"], find(window, **{k: v for k, v in own.items() if k != "weight"})))
    return Curvature(
        lambda d: sum((weight * H.product(d) for weight, H in weighted), start=jnp.zeros_like(d)),
        sum((weight * H.diagonal for weight, H in weighted), start=jnp.zeros(())),
    )


def _scalar(name: str, value: Any) -> Float[Array, ""]:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        array = None
    if array is not None and array.shape == () and jnp.issubdtype(array.dtype, jnp.floating):
        return array
    what = type(value).__name__ if array is None else f"{array.dtype} of shape {array.shape}"
    raise InputError(f"term {name!r}", f"returned {what}, not one real number", "sum it over frames and joints")
