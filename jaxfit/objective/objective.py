"""The objective: the weighted sum of its terms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.foundation.errors import InputError
from jaxfit.objective.curvature import Curvature, FrameBlocks, block_curvature, frame_rows, sum_of_curvatures
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import Term
from jaxfit.objective.residuals import Residuals, as_list, residual_curvature, residual_sum

Settings = Mapping[str, Mapping[str, Float[Array | np.ndarray, ""] | float]]
"""The `weight` and the other settings of each active term; all values may be traced."""


def evaluate_terms(window: PosedWindow, terms: Mapping[str, Term], settings: Settings) -> dict[str, Float[Array, ""]]:
    """Return the unweighted value of each term of `settings`.

    Args:
        window: one bird in one window.
        terms: name → term, as `registry.find_terms` returns them, for every name in `settings`.
        settings: weight and settings of each active term.

    Raises:
        InputError: a term does not return one real number; the error names the term.
    """
    return {
        name: _checked_scalar(name, terms[name].function(window, **_without_weight(values)))
        for name, values in settings.items()
    }


def weighted_sum(window: PosedWindow, terms: Mapping[str, Term], settings: Settings) -> Float[Array, ""]:
    """Return E = Σ λ · E_term over the active terms; arguments as for `evaluate_terms`.

    Source: Hägerlind et al. 2024, total objective.
    """
    values = evaluate_terms(window, terms, settings)
    return sum((jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()), start=jnp.zeros(()))


def sum_with_blocks(
    window: PosedWindow, terms: Mapping[str, Term], settings: Settings
) -> tuple[Float[Array, ""], FrameBlocks | None]:
    """Return `weighted_sum`, and Σ λ · blocks of the terms with blocks (None without such a term), in one pass.

    Raises:
        InputError: a term does not return one real number, or blocks of another shape; the error names the term.
    """
    blocks = [name for name in settings if terms[name].with_blocks is not None]
    total = weighted_sum(window, terms, {name: values for name, values in settings.items() if name not in blocks})
    summed, (frames, columns) = None, frame_rows(window.pose, window.shared).shape
    shape = (frames, columns, columns)
    for name in blocks:
        weight = jnp.asarray(settings[name]["weight"])
        value, block = cast(Any, terms[name].with_blocks)(window, **_without_weight(settings[name]))
        total += weight * _checked_scalar(name, value)
        if jnp.shape(block) != shape:
            problem = f"`with_blocks` returned blocks of shape {jnp.shape(block)}, not {shape}"
            raise InputError(f"term {name!r}", problem, "return one block for each frame, in the columns of frame_rows")
        summed = weight * block if summed is None else summed + weight * block
    return total, summed


def evaluate_curvature(
    window: PosedWindow,
    terms: Mapping[str, Term],
    settings: Settings,
    second_order: bool = False,
    blocks: FrameBlocks | None = None,
) -> Curvature:
    """Return Σ λ · H_term over the active terms, from their blocks or from their residuals.

    Args:
        window: one bird in one window.
        terms, settings: as for `evaluate_terms`.
        second_order: whether H includes the second derivatives of robust kernels, as `residual_curvature` describes.
            Blocks do not distinguish.
        blocks: the second result of `sum_with_blocks` at this window; None computes it.

    Raises:
        InputError: a term has no blocks and does not return residuals; the error names the term.
    """

    def residuals_of(name: str, window: PosedWindow) -> list[Residuals]:
        values = settings[name]
        parts = _checked_residuals(name, terms[name].function(window, **_without_weight(values)))
        return [part._replace(weight=jnp.asarray(values["weight"]) * part.weight) for part in parts]

    if blocks is None:
        with_blocks = {name: values for name, values in settings.items() if terms[name].with_blocks is not None}
        blocks = sum_with_blocks(window, terms, with_blocks)[1]
    of_residuals = [partial(residuals_of, name) for name in settings if terms[name].with_blocks is None]
    curvatures = [residual_curvature(window, of_residuals, second_order)]
    if blocks is not None:
        curvatures.append(block_curvature(blocks))
    return sum_of_curvatures(curvatures)


def _without_weight(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name != "weight"}


def _checked_residuals(name: str, value: Any) -> list[Residuals]:
    """Return the residuals of a term after a check that the term returns residuals."""
    if _is_residuals(value):
        return as_list(value)
    problem = (
        "returns a number, but the solver levenberg_marquardt and error bars need its residuals (or `with_blocks`)"
    )
    remedy = "return Residuals (docs/developers/term.md), or use the solver adam without error_bars"
    raise InputError(f"term {name!r}", problem, remedy)


def _is_residuals(value: Any) -> bool:
    if isinstance(value, Residuals):
        return True
    return isinstance(value, tuple | list) and len(value) > 0 and all(isinstance(each, Residuals) for each in value)


def _checked_scalar(name: str, value: Any) -> Float[Array, ""]:
    """Return the value of a term as an array after a check that the value is one real number, or residuals."""
    try:
        array = residual_sum(value) if _is_residuals(value) else jnp.asarray(value)
    except (TypeError, ValueError):
        array = None
    if array is not None and array.shape == () and jnp.issubdtype(array.dtype, jnp.floating):
        return array
    returned = type(value).__name__ if array is None else f"{array.dtype} of shape {array.shape}"
    remedy = "sum the values over frames and joints"
    raise InputError(f"term {name!r}", f"returned {returned}, not one real number", remedy)
