"""Which of the files a user gave is the mesh, and which the prior."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxfit.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.importers.published import import_aves, import_avian_mesh, read_model_json
from jaxfit.model.importers.torch_file import read_tensors

__all__ = ["MODEL_KINDS", "import_sources"]

MODEL_KINDS = ("avian-mesh", "aves")
"""The published models that can be imported."""
SUFFIXES = (".json", ".pt", ".pth")
NAMES = {"mesh": "bird_eccv.json", "aves": "aves.pt", "prior": "pose_bone_prior.pth"}


def import_sources(kind: str, sources: Sequence[Path | str]) -> Bird:
    """Import a published model from its files, given in any order or as the folder that holds them.

    Args:
        kind: "avian-mesh" (`bird_eccv.json` and `pose_bone_prior.pth`) or "aves" (`aves.pt`; a prior is
            optional and replaces the one inside).
        sources: files or folders. From a folder, files that the model does not need are passed over; a
            file named by itself must be of use.

    Raises:
        ValueError: an unknown kind.
        InputError: a file is missing, given twice, or is not what the model needs.
    """
    if kind not in MODEL_KINDS:
        raise ValueError(f"kind must be one of {', '.join(MODEL_KINDS)}, not {kind!r}")
    main = "mesh" if kind == "avian-mesh" else "aves"
    needed = {NAMES[main]} | ({NAMES["prior"]} if kind == "avian-mesh" else set())
    found: dict[str, Path] = {}
    for path, chosen in _files(sources):
        # a file that carries the expected name is surely meant, even when only its folder was given
        role = _role(path, strict=chosen or path.name in needed)
        if role not in (main, "prior"):
            if chosen:
                wanted = f"{kind} needs {NAMES[main]} and {NAMES['prior']}"
                raise InputError(path, f"not a file of the {kind} model", wanted)
            continue
        # A folder may hold the prior that aves.pt contains already: the model's own stays.
        if role == "prior" and kind == "aves" and not chosen:
            continue
        if role in found and found[role].resolve() != path.resolve():
            problem = f"a second {NAMES[role]} beside {found[role]}"
            raise InputError(path, problem, "give one of the two, by its file name")
        found[role] = path
    shown = ", ".join(map(str, sources)) or "nothing"
    if main not in found:
        raise InputError(shown, f"holds no {NAMES[main]}", f"give the {kind} model's {NAMES[main]}")
    if kind == "aves":
        return import_aves(found["aves"], found.get("prior"))
    return import_avian_mesh(found["mesh"], found.get("prior"))


def _files(sources: Sequence[Path | str]) -> list[tuple[Path, bool]]:
    """(file, whether it was named by itself) for every source."""
    files: list[tuple[Path, bool]] = []
    for source in map(Path, sources):
        try:
            if source.is_dir():
                inside = [path for path in sorted(source.iterdir()) if path.is_file()]
                files += [(path, False) for path in inside if path.suffix.lower() in SUFFIXES]
            elif source.is_file():
                files.append((source, True))
            else:
                raise InputError(source, "no such file or folder", "check the path")
        except OSError as error:
            raise InputError(source, f"cannot be read: {error.strerror}", "check the permissions") from error
    return files


def _role(path: Path, strict: bool) -> str:
    """ "mesh", "aves", "prior" or "other", by content; a damaged file is an error if `strict`."""
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
