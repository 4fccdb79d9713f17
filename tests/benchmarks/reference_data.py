"""Where the reference data lies that demo and benchmarks use: published models and annotated photographs."""

from __future__ import annotations

import os
from pathlib import Path

from jaxfit.model.bird import Bird
from jaxfit.model.importers.import_model import import_model

__all__ = ["reference_bird", "reference_folder"]


def reference_folder() -> Path | None:
    """The folder named by JAXFIT_REFERENCE, else `../shared`; None where it holds no bird model."""
    folder = Path(os.environ.get("JAXFIT_REFERENCE") or Path("..") / "shared")
    return folder if (folder / "models" / "aves").is_dir() else None


def reference_bird() -> Bird | None:
    """The AVES model of the reference data, if that is there."""
    folder = reference_folder()
    return None if folder is None else import_model("aves", [folder / "models" / "aves"])
