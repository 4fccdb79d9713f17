"""Find the files of a published bird model among the user's paths, and import the model."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from jaxfit.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.importers.aves import import_aves
from jaxfit.model.importers.avian_mesh import import_avian_mesh, read_model_json
from jaxfit.model.importers.torch_file import read_tensors
from jaxfit.storage.reading import check_readable

__all__ = ["MODEL_KINDS", "import_model"]

MODEL_KINDS = ("avian-mesh", "aves")
"""Published models that jaxfit imports."""
SUFFIXES = (".json", ".pt", ".pth")
FILE_NAMES = {"mesh": "bird_eccv.json", "aves": "aves.pt", "prior": "pose_bone_prior.pth"}
"""Published name of the file for each role."""


def import_model(kind: str, sources: Sequence[Path | str]) -> Bird:
    """Import a published model from its files, in any order, or from the folder that contains them.

    Args:
        kind: "avian-mesh" (`bird_eccv.json` and `pose_bone_prior.pth`) or "aves" (`aves.pt`; a prior is
            optional and replaces the prior of `aves.pt`).
        sources: files or folders. In a folder, files that the model does not need are ignored. A file that is
            named explicitly must belong to the model.

    Raises:
        ValueError: an unknown kind.
        InputError: a file is missing, is given twice, or does not belong to the model.
    """
    if kind not in MODEL_KINDS:
        raise ValueError(f"kind must be one of {', '.join(MODEL_KINDS)}, not {kind!r}")
    main = "mesh" if kind == "avian-mesh" else "aves"
    needed = {FILE_NAMES[main]} | ({FILE_NAMES["prior"]} if kind == "avian-mesh" else set())
    chosen: dict[str, Path] = {}
    for path, explicit in _list_files(sources):
        # a damaged file with the expected name is an error, even where the user named only its folder
        role = _role(path, strict=explicit or path.name in needed)
        if role not in (main, "prior"):
            if explicit:
                remedy = f"{kind} needs {FILE_NAMES[main]} and {FILE_NAMES['prior']}"
                raise InputError(path, f"not a file of the {kind} model", remedy)
            continue
        # aves.pt contains a prior already: only an explicit file replaces that prior
        if role == "prior" and kind == "aves" and not explicit:
            continue
        if role in chosen and chosen[role].resolve() != path.resolve():
            problem = f"a second {FILE_NAMES[role]} beside {chosen[role]}"
            raise InputError(path, problem, "give one of the two, by its file name")
        chosen[role] = path
    shown = ", ".join(map(str, sources)) or "nothing"
    if main not in chosen:
        raise InputError(shown, f"holds no {FILE_NAMES[main]}", f"give the {kind} model's {FILE_NAMES[main]}")
    if kind == "aves":
        return import_aves(chosen["aves"], chosen.get("prior"))
    return import_avian_mesh(chosen["mesh"], chosen.get("prior"))


def _list_files(sources: Sequence[Path | str]) -> list[tuple[Path, bool]]:
    """Return (file, whether the user named this file explicitly) for all sources."""
    files: list[tuple[Path, bool]] = []
    for source in map(Path, sources):
        if os.path.isdir(source):  # noqa: PTH112 - False for paths that cannot exist
            try:
                inside = [path for path in sorted(source.iterdir()) if path.is_file()]
            except OSError as error:
                raise InputError(source, f"cannot be read: {error.strerror}", "check the permissions") from error
            files += [(path, False) for path in inside if path.suffix.lower() in SUFFIXES]
        else:
            files.append((check_readable(source, "a file of a bird model"), True))
    return files


def _role(path: Path, strict: bool) -> str:
    """Return "mesh", "aves", "prior" or "other", from the content; with `strict`, a damaged file is an error."""
    try:
        if path.suffix.lower() == ".json":
            keys = read_model_json(path).keys()
            return "mesh" if {"V", "J"} & keys else "other"
        keys = read_tensors(path).keys()
        return "aves" if "V" in keys else "prior" if {"p_m", "b_m"} & keys else "other"
    except InputError:
        if strict:
            raise
        return "other"
