"""The record of an ablation in its folder: the configs of the runs, and what else the results depend on."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxfit.ablation.grid import Run
from jaxfit.config.build import describes, plain_config
from jaxfit.data.formats.scene_folder import TRUE_POSES, TRUTH
from jaxfit.errors import InputError
from jaxfit.limits import ABLATION_BYTES
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash
from jaxfit.storage.files import write_whole
from jaxfit.storage.json_file import read_json_file
from jaxfit.storage.temporary import remove_leftovers

__all__ = ["claim_folder"]

FORMAT_VERSION = 2
_RECORD = "ablation.json"


def claim_folder(
    folder: Path, runs: Sequence[Run], inputs: dict[str, Path], bird: Bird, allow_import: Collection[str] = ()
) -> None:
    """Record this ablation in a new folder, or check that an existing folder belongs to this ablation.

    The configs in the record are compared as plain values. No term in the record is imported.

    Args:
        folder: the folder of the ablation.
        runs: the grid.
        inputs: name in messages → file that the results depend on.
        bird: the model.
        allow_import: terms `package.module:function` that the record may name, beside the terms of the grid.

    Raises:
        InputError: the folder holds something else, or another ablation; the message names the difference.
    """
    own = {
        "format_version": FORMAT_VERSION,
        "runs": {run.name: plain_config(run.config) for run in runs},
        "model": model_hash(bird),
        **{name: _digest(path) for name, path in inputs.items()},
    }
    path = folder / _RECORD
    if _is_new(folder):
        write_whole(path, json.dumps(own, indent=1).encode())
        return
    held = read_json_file(path, ABLATION_BYTES)
    if not isinstance(held, dict) or not isinstance(held.get("runs"), dict):
        raise InputError(path, "does not describe an ablation", "choose another --out")
    named = {name for run in own["runs"].values() for name in _import_paths(run)}
    for name in (name for run in held["runs"].values() for name in _import_paths(run)):
        if name not in named and name not in allow_import:
            remedy = f"only --allow-import {name} accepts such a record; or choose another --out"
            raise InputError(path, f"names the code {name!r}, which the grid does not name", remedy)
    differs = [name for name in own if name != "runs" and held.get(name) != own[name]]
    same = held["runs"].keys() == own["runs"].keys()
    if not same or not all(describes(held["runs"][run.name], run.config) for run in runs):
        differs.insert(0, "grid")
    if differs:
        remedy = "choose another --out, or remove that folder"
        raise InputError(folder, f"holds an ablation of another {', '.join(differs)}", remedy)


def _is_new(folder: Path) -> bool:
    """Return whether a folder is absent or empty; otherwise the folder must have a record."""
    remove_leftovers(folder)
    try:
        files = [file.name for file in folder.iterdir()]
    except FileNotFoundError:
        return True
    except NotADirectoryError:
        raise InputError(folder, "is a file, not a folder", "choose another --out") from None
    except (OSError, ValueError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else "is not a file name"
        raise InputError(folder, f"cannot be read: {reason}", "choose another --out") from None
    if files and _RECORD not in files:
        raise InputError(folder, f"holds files, but no {_RECORD}", "choose another --out")
    return not files


def _import_paths(run: Any) -> Iterator[str]:
    """Yield the terms of a stored config that are import paths, whatever else the config holds."""
    parts = [run] if isinstance(run, dict) else []
    if parts and isinstance(run.get("stages"), list):
        parts += [stage for stage in run["stages"] if isinstance(stage, dict)]
    for part in parts:
        for key in ("terms", "override"):
            names = part.get(key)
            if isinstance(names, dict | list):
                yield from (name for name in names if isinstance(name, str) and ":" in name)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the truth in the folder of a simulated scene."""
    digest = hashlib.sha256()
    for file in [path / TRUTH, *sorted((path / TRUE_POSES).glob("*.npz"))] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()
