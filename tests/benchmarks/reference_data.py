"""Find the reference data of demo and benchmarks: published models and annotated photographs."""

from __future__ import annotations

import os
from pathlib import Path

from jaxfit.model.bird import Bird
from jaxfit.model.published import import_model

__all__ = ["reference_bird", "reference_folder"]


def reference_folder() -> Path | None:
    """Return the folder that JAXFIT_REFERENCE names, or else `../shared`. None if it has no bird model."""
    folder = Path(os.environ.get("JAXFIT_REFERENCE") or Path("..") / "shared")
    return folder if (folder / "models" / "aves").is_dir() else None


def reference_bird() -> Bird | None:
    """Return the AVES model of the reference data. None without the data."""
    folder = reference_folder()
    return None if folder is None else import_model("aves", [folder / "models" / "aves"])
