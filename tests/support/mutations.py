"""Hypothesis strategies that damage valid files: bytes, trees of JSON or YAML, and sets of arrays."""

from __future__ import annotations

import copy
import io
import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

HOSTILE_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, -(2**63), 10**30),
    *(0.5, -0.0, 1e300, -1e300, 1e-300, math.nan, math.inf, -math.inf),
    *("", "a", "1", "nan", "\x00", "\n", "é\ud800", "x" * 5000, "../" * 50, "=a", "!!int 3"),
    *([], [[]], {}, [None], [1] * 1000, {"": {}}, {"a": [1]}),
)


@st.composite
def damaged_bytes(draw: Any, valid: bytes) -> bytes:
    """Return a file with one to four changes: bits flipped, bytes overwritten, inserted, removed, copied, cut."""
    content = bytearray(valid)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        length = draw(st.integers(1, 64))
        change = draw(st.sampled_from(("flip", "overwrite", "insert", "remove", "copy", "cut", "zero")))
        if change == "flip" and content:
            content[at] ^= 1 << draw(st.integers(0, 7))
        elif change == "overwrite":
            content[at : at + length] = draw(st.binary(min_size=1, max_size=16))
        elif change == "insert":
            content[at:at] = draw(st.binary(min_size=1, max_size=64))
        elif change == "remove":
            del content[at : at + length]
        elif change == "copy":
            source = draw(st.integers(0, max(len(content) - 1, 0)))
            content[at:at] = content[source : source + length]
        elif change == "cut":
            del content[at:]
        else:
            content[at : at + length] = bytes(length)
    return bytes(content)


@st.composite
def damaged_tree(draw: Any, valid: Any, values: tuple[Any, ...] = HOSTILE_VALUES) -> Any:
    """Return a tree of dicts and lists with one to three changes: values replaced, removed, doubled, swapped."""
    tree = copy.deepcopy(valid)
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(tree))
        if not places:
            return draw(st.sampled_from(values))
        parent, key = draw(st.sampled_from(places))
        change = draw(st.sampled_from(("replace", "replace", "remove", "double", "swap", "rename")))
        if change == "replace":
            parent[key] = copy.deepcopy(draw(st.sampled_from(values)))
        elif change == "remove":
            del parent[key]
        elif change == "double" and isinstance(parent, list):
            parent.append(copy.deepcopy(parent[key]))
        elif change == "swap":
            other_parent, other = draw(st.sampled_from(places))
            if isinstance(other_parent, list) and isinstance(other, int) and other >= len(other_parent):
                continue
            parent[key] = copy.deepcopy(other_parent[other])
        elif isinstance(parent, dict):
            parent[draw(st.sampled_from(("", "x", "\x00", "é", "base", "id", "k" * 400)))] = parent.pop(key)
    return tree


def _places(tree: Any) -> Any:
    """Yield (parent, key) of every value inside a tree."""
    pairs = list(tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ())
    for key, value in pairs:
        yield tree, key
        yield from _places(value)


@st.composite
def damaged_arrays(draw: Any, valid: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz with one to three changes: values, types, shapes, missing and surplus arrays."""
    arrays = {name: np.array(array) for name, array in valid.items()}
    for _ in range(draw(st.integers(1, 3))):
        if not arrays:
            break
        name = draw(st.sampled_from(sorted(arrays)))
        array = arrays[name]
        change = draw(st.sampled_from(("value", "value", "type", "shape", "remove", "rename", "duplicate", "bytes")))
        if change == "value" and array.size and array.dtype.kind in "iufb":
            value = draw(st.sampled_from((math.nan, math.inf, -math.inf, -1, 0, 1e38, -1e38, 2**40)))
            if array.dtype.kind in "iub":
                value = int(value) if math.isfinite(value) and abs(value) < 2**62 else -1
            with np.errstate(all="ignore"):
                flat = array.reshape(-1).copy()
                flat[draw(st.integers(0, array.size - 1))] = np.array(value).astype(array.dtype)
            arrays[name] = flat.reshape(array.shape)
        elif change == "type":
            kind = draw(st.sampled_from(("f2", "f4", "f8", "i1", "i8", "u8", "?", "c16", "U8", "S3", "M8[s]", "V4")))
            with np.errstate(all="ignore"):
                try:
                    arrays[name] = array.astype(kind)
                except (TypeError, ValueError, OverflowError):
                    arrays[name] = np.zeros(array.shape, kind)
        elif change == "shape":
            how = draw(st.sampled_from(("flat", "axis", "first", "empty", "twice", "scalar")))
            arrays[name] = {
                "flat": lambda a: a.reshape(-1),
                "axis": lambda a: a[None],
                "first": lambda a: a[:1] if a.ndim else a,
                "empty": lambda a: a[:0] if a.ndim else np.zeros(0, a.dtype),
                "twice": lambda a: np.concatenate([a, a]) if a.ndim else np.stack([a, a]),
                "scalar": lambda a: a.reshape(-1)[0] if a.size else np.zeros((), a.dtype),
            }[how](array)
        elif change == "remove":
            del arrays[name]
        elif change == "rename":
            arrays[draw(st.sampled_from(("x", "é", "a/b", "..", "format_version")))] = arrays.pop(name)
        elif change == "duplicate" and array.ndim and len(array) > 1:
            arrays[name] = np.concatenate([array[:1], array[:-1]])
        else:
            arrays[name] = np.frombuffer(draw(st.binary(max_size=64)), np.uint8)
    return arrays


def damaged_npz(valid: bytes) -> st.SearchStrategy[bytes]:
    """Return files like an .npz with damaged bytes, or with the arrays of `damaged_arrays`."""

    def saved(arrays: dict[str, np.ndarray]) -> bytes:
        file = io.BytesIO()
        np.savez(file, **arrays)
        return file.getvalue()

    with np.load(io.BytesIO(valid)) as stored:
        return damaged_bytes(valid) | damaged_arrays(dict(stored)).map(saved)
