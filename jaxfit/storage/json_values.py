"""JSON text of results: NumPy values become Python values, and NaN and infinite numbers become null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["json_text", "json_values"]


def json_text(content: Any, indent: int | None = 2) -> str:
    """Return the JSON text of `json_values` of the content.

    Args:
        content: mappings, sequences, arrays and scalars.
        indent: spaces of each level; None writes one line.

    Raises:
        TypeError: the content holds a value that JSON cannot represent.
    """
    return json.dumps(json_values(content), indent=indent, allow_nan=False)


def json_values(content: Any) -> Any:
    """Return the content in the types of JSON.

    Arrays and tuples become lists, NumPy scalars become Python scalars, keys become text, and NaN and infinite
    numbers become None, since JSON has no such numbers.
    """
    if isinstance(content, np.ndarray | np.generic) or hasattr(content, "__array__"):
        content = np.asarray(content).tolist()
    if isinstance(content, Mapping):
        return {str(key): json_values(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [json_values(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
