"""Observations of any format for a command: names of keypoints mapped to those of the model, and shown as a table."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxfit.cli.tables import EscapedTable, show
from jaxfit.config.yaml_values import read_yaml
from jaxfit.data.formats.coco_exports import Untracked
from jaxfit.data.keypoint_names import NameMap, checked_map, map_keypoints, propose_names
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.limits import NAME_MAP_BYTES
from jaxfit.storage.reading import read_text

__all__ = ["MappedObservations", "image_size", "keypoint_map", "observations_for"]


class MappedObservations(NamedTuple):
    """Observations with the keypoints of a model, and the map of the names."""

    observations: Observations
    names: NameMap


def observations_for(
    path: Path,
    model_names: Sequence[str],
    options: argparse.Namespace,
    quiet: bool = False,
    untracked: Untracked = "video",
) -> MappedObservations:
    """Read a file of observations and map its keypoints to those of a model, by `--names` or by a proposal.

    Args:
        path: the file.
        model_names: names of the keypoints of the model.
        options: the options `video`, `size` and `names` of the command.
        quiet: whether to print no table.
        untracked: how a COCO file without any track is read; see `jaxfit.data.formats.coco_exports`.

    Raises:
        InputError: as `read_observations`; an unusable map, or no keypoint of the model.
    """
    from jaxfit.data.formats.recognise import read_observations  # imports the video libraries

    observations = read_observations(path, options.video, image_size(options), untracked)
    names = keypoint_map(observations.keypoint_names, path, model_names, options.names, quiet)
    return MappedObservations(map_keypoints(observations, names, model_names), names)


def keypoint_map(
    own: Sequence[str], path: Path, model_names: Sequence[str], map_file: Path | None, quiet: bool = False
) -> NameMap:
    """Return the map from the keypoints `own` of a file to those of a model; otherwise as `observations_for`."""
    if map_file is not None:
        names = checked_map(_read_map(map_file), own, model_names, map_file)
    else:
        names = propose_names(own, model_names)
    if not names.mapped:
        problem = f"has no keypoint of the model by name: it has {', '.join(own)}"
        raise InputError(path, problem, "map the names by --names MAP.yaml")
    if names.changes_names and not quiet:
        _show_names(names, path, proposed=map_file is None)
    return names


def image_size(options: argparse.Namespace) -> tuple[int, int] | None:
    """Return width and height of the option `size`, such as `640x480`; None without the option.

    Raises:
        InputError: the option is not two positive whole numbers.
    """
    if options.size is None:
        return None
    width, _, height = options.size.lower().partition("x")
    if not all(side.isascii() and side.isdecimal() and 1 <= len(side) <= 5 and int(side) for side in (width, height)):
        raise InputError("--size", f"is {options.size}", "give width and height in pixels, such as 640x480")
    return int(width), int(height)


def _show_names(names: NameMap, path: Path, proposed: bool) -> None:
    """Print the map of the names as a table, or only the unused keypoints if no name changes."""
    if all(old == new for old, new in names.mapped.items()):
        show(f"keypoints of {path.name} that are not used: {', '.join(names.unmapped)}")
        return
    table = EscapedTable()
    table.add_column("in the file")
    table.add_column("in the model")
    for old, new in names.mapped.items():
        table.add_row(old, new)
    for old in names.unmapped:
        table.add_row(old, "– (not used)")
    origin = "mapped by their words; --names MAP.yaml changes the map" if proposed else "mapped by --names"
    show(f"keypoints of {path.name}, {origin}:")
    show(table)
    if names.missing:
        show(f"keypoints of the model that the file lacks: {', '.join(names.missing)}")


def _read_map(path: Path) -> dict[str, str | None]:
    """Return the map of a YAML file with one line `name in the file: name in the model` for every keypoint."""
    remedy = "write lines such as `beak: bill_tip`; null leaves a keypoint out"
    value = read_yaml(read_text(path, NAME_MAP_BYTES, "a YAML file"), path).values
    if not value:
        raise InputError(path, "holds no map of names", remedy)
    for old, new in value.items():
        if not (new is None or isinstance(new, str)):
            raise InputError(path, f"maps {old!r} to {str(new)[:40]!r}, which is not a name", remedy)
    return value
