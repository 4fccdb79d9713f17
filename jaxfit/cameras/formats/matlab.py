"""Variables of a `.mat` file of MATLAB 5 to 7."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import open_file, reading

MAT_SIGNATURES = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n")
"""First bytes of a `.mat` file."""
_OLDER = "save the file again in MATLAB with save(..., '-v7')"


def read_variables(path: Path, wanted: Sequence[str]) -> dict[str, Any]:
    """Return the variables of a `.mat` file that have one of the wanted names.

    Numbers and arrays are numbers and nested lists, texts are str, cells are lists, and structs are dicts; an array, a
    cell or an array of structs with one entry is this entry.

    Raises:
        InputError: the file is damaged, or has version 7.3.
    """
    import scipy.io  # imported here because few commands read such files

    with open_file(path, "a .mat file") as file:
        if file.read(128).startswith(MAT_SIGNATURES[1:]):
            raise InputError(path, "is a .mat file of version 7.3, which jaxfit does not read", _OLDER)
    with reading(path, "a .mat file of MATLAB 5 to 7", _OLDER):
        content = scipy.io.loadmat(path, variable_names=list(wanted), simplify_cells=True)
    return {name: _plain(value) for name, value in content.items() if name in wanted}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return _plain(value.tolist()) if hasattr(value, "tolist") else value
