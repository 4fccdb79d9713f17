"""Shared fixtures: where the reference data lies."""

import os
from pathlib import Path

import pytest

DEFAULT_REFERENCE = Path(__file__).resolve().parents[1] / ".." / "shared"


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """The folder of reference data; the test skips where there is none."""
    named = os.environ.get("JAXFIT_REFERENCE")
    folder = Path(named) if named else DEFAULT_REFERENCE
    if not (folder / "reference").is_dir():
        if named:  # whoever names a folder wants its tests run: a gate must not pass on skips
            pytest.fail(f"JAXFIT_REFERENCE={named} holds no reference data")
        pytest.skip("no reference data: set JAXFIT_REFERENCE to its folder")
    return folder.resolve()
