"""The objective: the weighted sum of its terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.objective.curvature import Curvature, weighted_curvature
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import Term

__all__ = ["evaluate_curvature", "evaluate_terms", "weighted_sum"]

Settings = Mapping[str, Mapping[str, Float[Array | np.ndarray, ""] | float]]
"""For each active term its `weight` and its own settings; all may be traced."""


def evaluate_terms(window: PosedWindow, terms: Mapping[str, Term], settings: Settings) -> dict[str, Float[Array, ""]]:
    """Return the unweighted value of each term of `settings`.

    Args:
        window: one bird in one window.
        terms: the terms by name, at least those of `settings`, as `registry.find_terms` returns them.
        settings: weight and settings of each active term.

    Raises:
        InputError: a term returns something else than one real number; the error names the term.
    """
    return {name: _scalar(name, terms[name].function(window, **_own(values))) for name, values in settings.items()}


def weighted_sum(window: PosedWindow, terms: Mapping[str, Term], settings: Settings) -> Float[Array, ""]:
    """Return E = Σ λ · E_term over the active terms; arguments as for `evaluate_terms`.

    Source: Hägerlind et al. 2024, total objective.
    """
    values = evaluate_terms(window, terms, settings)
    return sum((jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()), start=jnp.zeros(()))


def evaluate_curvature(window: PosedWindow, terms: Mapping[str, Term], settings: Settings) -> Curvature:
    """Return Σ λ · H_term over the active terms, each of which must have a curvature.

    Args:
        window: one bird in one window.
        terms, settings: as for `evaluate_terms`.
    """
    weights, curvatures = [], []
    for name, values in settings.items():
        find = terms[name].curvature
        assert find is not None, name  # the config was checked
        weights.append(jnp.asarray(values["weight"]))
        curvatures.append(find(window, **_own(values)))
    return weighted_curvature(weights, curvatures)


def _own(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name != "weight"}


def _scalar(name: str, value: Any) -> Float[Array, ""]:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        array = None
    if array is not None and array.shape == () and jnp.issubdtype(array.dtype, jnp.floating):
        return array
    what = type(value).__name__ if array is None else f"{array.dtype} of shape {array.shape}"
    raise InputError(f"term {name!r}", f"returned {what}, not one real number", "sum it over frames and joints")
