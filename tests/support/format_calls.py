"""A reader that tests call in bounded children (`support.hostile`); h5py is imported once, before the children."""

from __future__ import annotations

import h5py  # noqa: F401

from jaxfit.data.formats.recognise import read_observations


def read_sized(path: str) -> None:
    """Read a file of observations in any format, with a size for files that store none."""
    read_observations(path, size_px=(120, 100))
