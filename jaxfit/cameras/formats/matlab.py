"""Variables of a `.mat` file of MATLAB 5 to 7.

scipy.io.loadmat can crash on a damaged file, so it runs in a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import open_file, reading

MAT_SIGNATURES = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n")
"""First bytes of a `.mat` file."""
_OLDER = "save the file again in MATLAB with save(..., '-v7')"
_SECONDS = 60
"""Longest time for a file."""
_SCRIPT = """
import json, sys
import scipy.io

def plain(value):
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return plain(value.tolist()) if hasattr(value, "tolist") else value

content = scipy.io.loadmat(sys.argv[1], variable_names=sys.argv[2:], simplify_cells=True)
json.dump({name: plain(value) for name, value in content.items() if name in sys.argv[2:]}, sys.stdout)
"""


def read_variables(path: Path, wanted: Sequence[str]) -> dict[str, Any]:
    """Return the variables of a `.mat` file that have one of the wanted names.

    Numbers and arrays are numbers and nested lists, texts are str, cells are lists, and structs are dicts; an array, a
    cell or an array of structs with one entry is this entry.

    Raises:
        InputError: the file is damaged, or has version 7.3.
    """
    with open_file(path, "a .mat file") as file:
        if file.read(128).startswith(MAT_SIGNATURES[1:]):
            raise InputError(path, "is a .mat file of version 7.3, which jaxfit does not read", _OLDER)
    with reading(path, "a .mat file of MATLAB 5 to 7", _OLDER):
        command = [sys.executable, "-P", "-c", _SCRIPT, str(path.absolute()), *wanted]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
        if done.returncode:
            raise ValueError(done.stderr.strip().rpartition("\n")[2] or "it is damaged")
        return json.loads(done.stdout)
