"""Metadata of ONNX files."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx

from jaxfit.storage.files import write_whole

__all__ = ["set_metadata"]


def set_metadata(path: str | Path, entries: Mapping[str, str]) -> None:
    """Set entries of the metadata of an ONNX file; other entries and the network do not change."""
    model = onnx.load(str(path))
    kept = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, kept | dict(entries))
    write_whole(path, model.SerializeToString())
